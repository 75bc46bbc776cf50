"""What patch networks are trained for: losses, objectives that apply them to patches, and figures of descriptors.

Row i of two descriptors is the same point. Of GeoDesc's loss (Luo et al., ECCV 2018, arXiv 1807.06294, section 3.5) the
authors' released code (lzx551402/tfmatch) has another form, so that none of theirs stands beside this one.
"""

import dataclasses
import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from fmtorch.features.frames import PatchFunction
from fmtorch.jit.random import Stream, uniform

DRAWS = 6  # random numbers in [0, 1) that an objective gets for each point
SAME_PATCH = 0.008  # a negative nearer than this is the same patch twice, as in the authors' code for HardNet
MARGINS = ((0.5, 0.7), (0.2, 0.5), (0.0, 0.2))  # GeoDesc: from this S_patch on, the similarity that a match should have
GALLERY = 1000  # patches among which each asks for its own
Pairs = Float[Tensor, "2 n 1 h w"]  # of patches with their surroundings
Draws = Float[Tensor, "n k"]  # all the randomness of a loss beside dropout


def distances(a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """Euclidean distances of unit vectors; the gradient stays finite where they coincide."""
    return (2 - 2 * a @ b.mT).clamp_min(1e-6).sqrt()


def hardest_triplet(a: Float[Tensor, "n d"], b: Float[Tensor, "n d"], *, margin: float = 1.0) -> Float[Tensor, ""]:
    """HardNet's loss (Mishchuk et al., NIPS 2017, eq. 4): max(0, margin + positive - hardest negative), the mean.
    The hardest negative in the batch is that of either end of a pair (anchor swap)."""
    d = distances(a, b)
    excluded = torch.eye(len(d), dtype=torch.bool, device=d.device) | (d < SAME_PATCH)
    negative = torch.where(excluded, 10.0, d)
    hardest = torch.minimum(negative.min(1).values, negative.min(0).values)
    return (margin + d.diagonal() - hardest).clamp_min(0).mean()


def geodesc(
    a: Float[Tensor, "*s n d"], b: Float[Tensor, "*s n d"], similarity: Float[Tensor, "*s n"],
    *, ratio: float = 0.4, geometric_weight: float = 0.2,
) -> Float[Tensor, ""]:  # fmt: skip
    """GeoDesc's loss E_1 + lambda E_2 of match sets: `structured` plus `geometric_weight` times `geometric`.
    a, b: unit descriptors of the n >= 2 matches of each set. similarity: S_patch of each match, in [0, 1]."""
    return structured(a, b, ratio=ratio) + geometric_weight * geometric(a, b, similarity)


def structured(a: Float[Tensor, "*s n d"], b: Float[Tensor, "*s n d"], *, ratio: float = 0.4) -> Float[Tensor, ""]:
    """The structured loss E_1: with S = A B^T and L = S - ratio diag(S), the mean over the sets of the sum over i and j
    of max(0, l_ij - l_ii) + max(0, l_ij - l_jj) by n (n - 1). No patch of the other photograph should be as similar as
    1 - `ratio` (alpha) of its own match."""
    similarity = a @ b.mT
    own = (1 - ratio) * similarity.diagonal(dim1=-2, dim2=-1)
    n = similarity.shape[-1]
    other = ~torch.eye(n, dtype=torch.bool, device=similarity.device)
    hinges = (similarity - own[..., :, None]).clamp_min(0) + (similarity - own[..., None, :]).clamp_min(0)
    return torch.where(other, hinges, 0.0).sum((-2, -1)).mean() / (n * (n - 1))


def geometric(
    a: Float[Tensor, "*s n d"], b: Float[Tensor, "*s n d"], similarity: Float[Tensor, "*s n"]
) -> Float[Tensor, ""]:
    """The geometric loss E_2: max(0, margin - cosine similarity) of each match, the mean, with `MARGINS`.
    The mean in place of the sum keeps the weight of the loss independent of n."""
    margin = torch.zeros_like(similarity)
    for threshold, value in reversed(MARGINS):
        margin = torch.where(similarity >= threshold, value, margin)
    return (margin - (a * b).sum(-1)).clamp_min(0).mean()


def fpr_at_recall(positive: Float[Tensor, " n"], negative: Float[Tensor, " m"], recall: float = 0.95) -> float:
    """Share of negatives at most as far apart as the positive distance below which `recall` of the positives lie."""
    threshold = positive.sort().values[max(0, -(-int(recall * 1e9) * len(positive) // 10**9) - 1)]
    return float((negative <= threshold).double().mean())


def patch_quality(a: Float[Tensor, "n d"], b: Float[Tensor, "n d"]) -> dict[str, float]:
    """Figures from two unit descriptors of each of n >= 2 points.
    fpr95: negatives are each point with the next one's other patch. map: each patch of `a` asks for its own among
    `GALLERY` patches of `b` (its block; the last block may be smaller); with one right answer average precision is the
    inverse of its rank, where equals count against it. accuracy: how often it ranks first."""
    positive = (a - b).square().sum(1).clamp_min(0).sqrt()
    negative = (a - b.roll(1, 0)).square().sum(1).clamp_min(0).sqrt()
    blocks = [distances(x, y) for x, y in zip(torch.split(a, GALLERY), torch.split(b, GALLERY), strict=True)]
    rank = torch.cat([(d <= d.diagonal()[:, None]).sum(1).double() for d in blocks])
    figures = {"map": float((1 / rank).mean()), "accuracy": float((rank == 1).double().mean())}
    return {"fpr95": fpr_at_recall(positive, negative), **figures}


def middle(patches: Float[Tensor, "*b h w"], size: int = 32) -> Float[Tensor, "*b size size"]:
    top, left = (patches.shape[-2] - size) // 2, (patches.shape[-1] - size) // 2
    return patches[..., top : top + size, left : left + size]


@torch.no_grad()
def evaluate_descriptor(describe: PatchFunction, pairs: Pairs) -> dict[str, float]:
    """`patch_quality` of a descriptor on validation pairs."""
    parts = ([describe(part).float() for part in torch.split(middle(patches), 256)] for patches in pairs)
    return patch_quality(*(functional.normalize(torch.cat(described), dim=1) for described in parts))


@dataclasses.dataclass(frozen=True)
class DescriptorObjective:
    """Descriptors of a point's two patches should be nearer than those of different points: `criterion` says how.
    Of match sets it gets the descriptors (s, n, d), twice, and the S_patch (s, n) of their matches. teacher: a trained
    network that stays as it is; each descriptor should also be its descriptor of the same patch (FitNets' hints on the
    output, Romero et al., ICLR 2015). weight: of their squared distance in the loss."""

    criterion: Callable[..., Tensor]
    teacher: PatchFunction | None = None
    weight: float = 1.0

    def loss(self, network: nn.Module, pairs: Pairs, draws: Draws, similarity: Tensor | None = None) -> Tensor:
        patches = middle(pairs)
        left, up, over = (draws[:, column, None, None, None] < 0.5 for column in range(3))
        patches = torch.where(left, patches.flip(-1), patches)
        patches = torch.where(up, patches.flip(-2), patches)
        patches = torch.where(over, patches.mT, patches).flatten(0, 1)
        described = network(patches)
        a, b = described.chunk(2)
        if similarity is None:
            loss = self.criterion(a, b)
        else:
            loss = self.criterion(*(x.reshape(*similarity.shape, -1) for x in (a, b)), similarity)
        if self.teacher is not None:
            with torch.no_grad():
                target = self.teacher(patches)
            loss = loss + self.weight * (described - target).square().sum(1).mean()
        return loss

    def evaluate(self, network: nn.Module, pairs: Pairs) -> dict[str, float]:
        return evaluate_descriptor(network, pairs)


@dataclasses.dataclass(frozen=True)
class CovarianceObjective:
    """Shapes should follow what is done to a patch (as Lenc and Vedaldi, ECCV Workshops 2016, train detectors).
    A patch is turned and stretched in two ways T1 and T2, up to `tilt` each. With the shapes A1 and A2 found then, T1
    A1 and T2 A2 rectify the same patch, so (T1 A1)^-1 T2 A2 should be a rotation. Unlike the loss on descriptors it
    cannot be met by one shape for all patches, and needs no descriptor. teacher: a trained network that stays as it is;
    each shape should also be its shape of the same patch. weight: of that part of the loss, which is measured alike."""

    tilt: float = 2.5
    teacher: PatchFunction | None = None
    weight: float = 1.0

    def loss(self, network: nn.Module, pairs: Pairs, draws: Draws, similarity: Tensor | None = None) -> Tensor:
        """Mean of log((s^2 + s^-2) / 2) for singular values s and 1 / s of what should be a rotation: 0 where it is."""
        T1, T2, seen = self._stretched(pairs.flatten(0, 1), torch.cat([draws, draws]))
        shapes = shape_matrix(network(seen))
        A1, A2 = shapes.chunk(2)
        loss = _departure(_inverse(T1 @ A1) @ T2 @ A2)
        if self.teacher is not None:
            with torch.no_grad():
                target = shape_matrix(self.teacher(seen))
            loss = loss + self.weight * _departure(_inverse(target) @ shapes)
        return loss

    @torch.no_grad()
    def evaluate(self, network: nn.Module, pairs: Pairs) -> dict[str, float]:
        """Median ratio of axes that is left between the two rectified patches, and without shapes (1: none)."""
        numbers = uniform(0, torch.zeros(1, dtype=torch.int64), Stream.TRAINING, 0, len(pairs[0]), DRAWS)[0]
        T1, T2, seen = self._stretched(pairs[0], numbers.to(pairs[0]))
        A1, A2 = shape_matrix(network(seen)).chunk(2)
        values = [torch.linalg.svdvals(m.cpu()) for m in (_inverse(T1 @ A1) @ T2 @ A2, _inverse(T1) @ T2)]
        medians = [float((s[:, 0] / s[:, 1]).median()) for s in values]
        return dict(zip(("residual_tilt", "circle_residual_tilt"), medians, strict=True))

    def _stretched(self, patches: Float[Tensor, "n 1 h w"], draws: Float[Tensor, "n k"]) -> tuple[Tensor, ...]:
        """T1 and T2 of each patch, and the patches through T1, then through T2."""
        T1, T2 = (
            _rotation(2 * math.pi * draws[:, i]) @ _stretch(self.tilt ** draws[:, i + 1], math.pi * draws[:, i + 2])
            for i in (0, 3)
        )
        return T1, T2, torch.cat([sample(patches, T1), sample(patches, T2)])


Objective = DescriptorObjective | CovarianceObjective


def _departure(matrix: Float[Tensor, "n 2 2"]) -> Float[Tensor, ""]:
    """Mean of log((s^2 + s^-2) / 2) of matrices of determinant 1: how far they are from rotations."""
    return (matrix.square().sum((1, 2)) / 2).log().mean()


def shape_matrix(x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 2"]:
    """AffNet's output as a lower-triangular matrix of determinant 1."""
    diagonal = 1 + x[:, ::2]
    scale = diagonal.prod(1).clamp_min(1e-6).rsqrt()
    zero = torch.zeros_like(x[:, 0])
    return torch.stack([diagonal[:, 0], zero, x[:, 1], diagonal[:, 1]], -1).reshape(-1, 2, 2) * scale[:, None, None]


def sample(patches: Float[Tensor, "n 1 h w"], frame: Float[Tensor, "n 2 2"], size: int = 32) -> Tensor:
    """The middle `size` x `size` pixels of patches seen through a linear map of the patch's own coordinates."""
    scale = torch.tensor([size / patches.shape[-1], size / patches.shape[-2]], device=frame.device)
    theta = torch.cat([frame * scale[:, None], torch.zeros_like(frame[..., :1])], -1)
    grid = functional.affine_grid(theta, [len(patches), 1, size, size], align_corners=False)
    return functional.grid_sample(patches, grid, padding_mode="reflection", align_corners=False)


def _inverse(matrix: Float[Tensor, "n 2 2"]) -> Float[Tensor, "n 2 2"]:
    a, b, c, d = matrix.flatten(1).unbind(1)
    return torch.stack([d, -b, -c, a], -1).reshape(-1, 2, 2)


def _rotation(angle: Float[Tensor, " n"]) -> Float[Tensor, "n 2 2"]:
    c, s = angle.cos(), angle.sin()
    return torch.stack([c, -s, s, c], -1).reshape(-1, 2, 2)


def _stretch(ratio: Float[Tensor, " n"], axis: Float[Tensor, " n"]) -> Float[Tensor, "n 2 2"]:
    """Symmetric matrices of determinant 1 with this ratio of axes, the long one in this direction."""
    R = _rotation(axis)
    return R @ torch.diag_embed(torch.stack([ratio.sqrt(), ratio.rsqrt()], -1)) @ R.mT
