"""The match domain: where a match is, where it goes and how its frame changes; and Gaussians over it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.pruning.frame_consistency import frame_map

BLOCK = 4096  # matches whose basis functions exist at a time
LARGEST_CHANGE = 100.0  # of a frame's size between images of a common scale: what is beyond is no match


class MatchDomain(NamedTuple):
    """The N matches of one pair, in coordinates of zero mean and unit mean square in each image.

    S is the linear map from frame 0 to frame 1; shape its entries scaled to Frobenius norm sqrt(2), which for a
    similarity are the cosine and the sine of its rotation, and the logarithm of the factor taken out.
    """

    p0: Float[Tensor, "n 2"]
    p1: Float[Tensor, "n 2"]
    S: Float[Tensor, "n 2 2"]
    shape: Float[Tensor, "n 5"]

    def take(self, index: Int[Tensor, " m"]) -> MatchDomain:
        """The matches at `index`."""
        return MatchDomain(*(value[index] for value in self))

    def blocks(self) -> list[MatchDomain]:
        """The matches in their order, at most BLOCK at a time."""
        return [MatchDomain(*part) for part in zip(*(torch.split(value, BLOCK) for value in self), strict=True)]


def match_domain(
    x0: Float[Tensor, "n 2"],
    x1: Float[Tensor, "n 2"],
    lafs0: Float[Tensor, "n 2 3"] | None,
    lafs1: Float[Tensor, "n 2 3"] | None,
) -> MatchDomain:
    """The domain of the matches, float32; without frames S is the identity."""
    p0, spread0 = _normalized(x0)
    p1, spread1 = _normalized(x1)
    if lafs0 is None or lafs1 is None:
        S = torch.eye(2, dtype=torch.float64, device=x0.device).expand(len(x0), 2, 2)
    else:
        S = frame_map(lafs0[None].double(), lafs1[None].double())[0] * (spread0 / spread1)
    size = S.square().sum((1, 2)).sqrt().clamp_min(torch.finfo(torch.float32).tiny) / math.sqrt(2)
    entries = S / size[:, None, None]
    bounded = S * (size.clamp(1 / LARGEST_CHANGE, LARGEST_CHANGE) / size)[:, None, None]
    shape = torch.cat([entries.flatten(1), torch.log(size)[:, None]], 1)
    return MatchDomain(p0.float(), p1.float(), bounded.float(), shape.float())


def finite_matches(*values: Tensor | None) -> Bool[Tensor, "b n"]:
    """True where every value of a match, (B, N, ...), is finite and no frame (B, N, 2, 3) is degenerate."""
    given = [value for value in values if value is not None]
    mask = torch.stack([torch.isfinite(v.flatten(2)).all(-1) for v in given]).all(0)
    for frame in (v for v in given if v.dim() == 4):
        (a, b), (c, d) = (row.unbind(-1) for row in frame[..., :2].double().unbind(-2))
        mask = mask & ((a * d - b * c) != 0)
    return mask


def _normalized(x: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, ""]]:
    """Points with zero mean and unit mean square, and the root mean square taken out, 1 where all points are equal."""
    centred = x.double() - x.double().mean(0)
    spread = centred.square().mean().sqrt()
    spread = torch.where(spread > 0, spread, 1.0)
    return centred / spread, spread


def gaussians(z: Float[Tensor, "n d"], centres: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """``exp(-|z_j - c_m|^2 / 2)``."""
    return _exponent(z, centres).clamp_(max=0).exp_()


def predictive_gaussians(
    matches: MatchDomain,
    centres: MatchDomain,
    *,
    position: float,
    displacement: float,
    rotation: float,
    scale: float,
) -> Float[Tensor, "n m"]:
    """Gaussians over position, displacement and shape, where each centre's frame predicts the displacement.

    With differences from centre m to match j, ``exp(-(|dp0|^2 / position^2 + |dp1 - S_m dp0|^2 / displacement^2 +
    |d entries|^2 / rotation^2 + |d log size|^2 / scale^2) / 2)``: the widths, in units of the normalised coordinates.
    """
    width = torch.tensor([position] * 2 + [rotation] * 4 + [scale], device=matches.p0.device)
    z, c = (torch.cat([part.p0, part.shape], 1) / width for part in (matches, centres))
    exponent = _exponent(z, c)
    x, y = centres.p0.unbind(1)
    homogeneous = torch.cat([matches.p0, torch.ones_like(matches.p0[:, :1])], 1)
    for axis in (0, 1):  # p1_j - p1_m - S_m (p0_j - p0_m) is linear in (p0_j, 1) for each centre
        to_x, to_y = centres.S[:, axis].unbind(1)
        predicted = homogeneous @ torch.stack([to_x, to_y, centres.p1[:, axis] - to_x * x - to_y * y])
        exponent -= (predicted - matches.p1[:, axis : axis + 1]).div_(displacement).square_().div_(2)
    return exponent.clamp_(max=0).exp_()


def _exponent(z: Float[Tensor, "n d"], centres: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """``-|z_j - c_m|^2 / 2``, up to rounding."""
    exponent = z @ centres.T
    exponent -= z.square().sum(1, keepdim=True) / 2
    exponent -= centres.square().sum(1) / 2
    return exponent


def spread_centres(kernel: Float[Tensor, "n n"], count: int) -> Int[Tensor, " m"]:
    """Indices of at most `count` of the points, crowded places first, none near another; the first of equals.

    kernel (i, j): what the Gaussian at j gives at i. Each centre is the point with the largest uncovered support: the
    sum of its Gaussian over all points, times one minus the largest Gaussian of earlier centres at it. Coherent matches
    crowd, wrong ones are alone.
    """
    support = kernel.sum(0)
    uncovered = torch.ones_like(support)
    by_centre = kernel.T.contiguous()
    chosen: list[Tensor] = []
    for _ in range(min(count, len(kernel))):
        best = (support * uncovered).argmax()
        chosen.append(best)
        uncovered = torch.minimum(uncovered, 1 - by_centre[best])
    return torch.stack(chosen) if chosen else torch.zeros(0, dtype=torch.int64, device=kernel.device)


def evenly(index: Int[Tensor, " n"], count: int) -> Int[Tensor, " m"]:
    """At most `count` of the indices, evenly along their order."""
    if len(index) <= count:
        return index
    return index[torch.arange(count, device=index.device) * len(index) // count]
