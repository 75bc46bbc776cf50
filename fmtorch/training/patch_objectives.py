"""What a patch network is trained for: from two patches of each point to a loss."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from fmtorch.features.frames import PatchFunction
from fmtorch.jit import random
from fmtorch.jit.random import Stream
from fmtorch.training.patch_losses import hard_negative_constant
from fmtorch.training.patch_metrics import evaluate_descriptor, middle, patch_quality

DRAWS = 6
"""Random numbers in [0, 1) that an objective gets for each point."""


@runtime_checkable
class Objective(Protocol):
    """A loss of a network on pairs of patches with their surroundings, and its figures on validation pairs."""

    def loss(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"], draws: Float[Tensor, "n k"]) -> Tensor:
        """The loss; `draws` are all the randomness there is beside dropout."""
        ...

    def evaluate(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"]) -> dict[str, float]:
        """Figures for the log and the model card."""
        ...


@dataclasses.dataclass(frozen=True)
class DescriptorObjective:
    """Descriptors of a point's two patches should be nearer than those of different points: `criterion` says how.

    teacher: a trained network that stays as it is; each descriptor should also be its descriptor of the same patch
    (FitNets' hints on the output, Romero et al., ICLR 2015). weight: of their squared distance in the loss.
    """

    criterion: Callable[[Tensor, Tensor], Tensor]
    teacher: PatchFunction | None = None
    weight: float = 1.0

    def loss(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"], draws: Float[Tensor, "n k"]) -> Tensor:
        """The criterion on both patches of each point, mirrored and turned alike at random."""
        patches = middle(pairs)
        left, up, over = (draws[:, column, None, None, None] < 0.5 for column in range(3))
        patches = torch.where(left, patches.flip(-1), patches)
        patches = torch.where(up, patches.flip(-2), patches)
        patches = torch.where(over, patches.mT, patches).flatten(0, 1)
        described = network(patches)
        loss = self.criterion(*described.chunk(2))
        if self.teacher is not None:
            with torch.no_grad():
                target = self.teacher(patches)
            loss = loss + self.weight * (described - target).square().sum(1).mean()
        return loss

    def evaluate(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"]) -> dict[str, float]:
        """`patch_quality` of the descriptors."""
        return evaluate_descriptor(network, pairs)


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeObjective:
    """Patches rectified by their estimated affine shapes should be described alike (Mishkin et al., ECCV 2018).

    descriptor: a trained network that stays as it is. tilt: the largest ratio of axes by which each patch is stretched
    in a random direction on its own, after both were turned by one random angle.
    """

    descriptor: nn.Module
    tilt: float = 2.0

    def loss(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"], draws: Float[Tensor, "n k"]) -> Tensor:
        """The hard negative-constant loss."""
        a, b = self._described(network, pairs, draws, rectify=True)
        return hard_negative_constant(a, b)

    @torch.no_grad()
    def evaluate(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"]) -> dict[str, float]:
        """`patch_quality` of stretched patches with the network's shapes, and with circles for comparison."""
        n = pairs.shape[1]
        draws = random.uniform(0, torch.zeros(1, dtype=torch.int64), Stream.TRAINING, 0, n, DRAWS)[0]
        draws = draws.to(pairs)
        figures: dict[str, float] = {}
        for name, rectify in (("", True), ("circle_", False)):
            parts = [
                self._described(network, pairs[:, i : i + 256], draws[i : i + 256], rectify) for i in range(0, n, 256)
            ]
            quality = patch_quality(torch.cat([a for a, _ in parts]), torch.cat([b for _, b in parts]))
            figures |= {f"{name}{key}": value for key, value in quality.items()}
        return figures

    def _described(
        self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"], draws: Float[Tensor, "n k"], rectify: bool
    ) -> tuple[Tensor, Tensor]:
        turn = _rotation(2 * math.pi * draws[:, 0])
        stretches = [turn @ _stretch(self.tilt ** draws[:, i], math.pi * draws[:, i + 1]) for i in (1, 3)]
        patches = pairs.flatten(0, 1)
        frame = torch.cat(stretches)
        if rectify:
            frame = frame @ shape_matrix(network(sample(patches, frame)))
        a, b = self.descriptor(sample(patches, frame)).chunk(2)
        return a, b


@dataclasses.dataclass(frozen=True)
class CovarianceObjective:
    """Shapes should follow what is done to a patch (as Lenc and Vedaldi, ECCV Workshops 2016, train detectors).

    A patch is turned and stretched in two ways T1 and T2, up to `tilt` each. With the shapes A1 and A2 found then,
    T1 A1 and T2 A2 rectify the same patch, so (T1 A1)^-1 T2 A2 should be a rotation. Unlike the loss on descriptors it
    cannot be met by one shape for all patches, and needs no descriptor.

    teacher: a trained network that stays as it is; each shape should also be its shape of the same patch. weight: of
    that part of the loss, which is measured alike.
    """

    tilt: float = 2.5
    teacher: PatchFunction | None = None
    weight: float = 1.0

    def loss(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"], draws: Float[Tensor, "n k"]) -> Tensor:
        """Mean of log((s^2 + s^-2) / 2) for singular values s and 1 / s of what should be a rotation: 0 where it is."""
        (T1, T2), seen = self._stretched(pairs.flatten(0, 1), torch.cat([draws, draws]))
        shapes = shape_matrix(network(seen))
        A1, A2 = shapes.chunk(2)
        loss = _departure(_inverse(T1 @ A1) @ T2 @ A2)
        if self.teacher is not None:
            with torch.no_grad():
                target = shape_matrix(self.teacher(seen))
            loss = loss + self.weight * _departure(_inverse(target) @ shapes)
        return loss

    @torch.no_grad()
    def evaluate(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"]) -> dict[str, float]:
        """Median ratio of axes that is left between the two rectified patches, and without shapes (1: none)."""
        patches = pairs[0]
        draws = random.uniform(0, torch.zeros(1, dtype=torch.int64), Stream.TRAINING, 0, len(patches), DRAWS)[0]
        (T1, T2), seen = self._stretched(patches, draws.to(patches))
        A1, A2 = shape_matrix(network(seen)).chunk(2)
        values = [torch.linalg.svdvals(m.cpu()) for m in (_inverse(T1) @ T2, _inverse(T1 @ A1) @ T2 @ A2)]
        before, after = (float((s[:, 0] / s[:, 1]).median()) for s in values)
        return {"residual_tilt": after, "circle_residual_tilt": before}

    def _stretched(
        self, patches: Float[Tensor, "n 1 h w"], draws: Float[Tensor, "n k"]
    ) -> tuple[tuple[Tensor, Tensor], Float[Tensor, "m 1 s s"]]:
        """T1 and T2 of each patch, and the patches through T1, then through T2."""
        T1, T2 = (
            _rotation(2 * math.pi * draws[:, i]) @ _stretch(self.tilt ** draws[:, i + 1], math.pi * draws[:, i + 2])
            for i in (0, 3)
        )
        return (T1, T2), torch.cat([sample(patches, T1), sample(patches, T2)])


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
    """Of matrices of determinant 1."""
    (a, b), (c, d) = matrix.unbind(-2)[0].unbind(-1), matrix.unbind(-2)[1].unbind(-1)
    return torch.stack([d, -b, -c, a], -1).reshape(-1, 2, 2)


def _rotation(angle: Float[Tensor, " n"]) -> Float[Tensor, "n 2 2"]:
    c, s = angle.cos(), angle.sin()
    return torch.stack([c, -s, s, c], -1).reshape(-1, 2, 2)


def _stretch(ratio: Float[Tensor, " n"], axis: Float[Tensor, " n"]) -> Float[Tensor, "n 2 2"]:
    """Symmetric matrices of determinant 1 with this ratio of axes, the long one in this direction."""
    R = _rotation(axis)
    return R @ torch.diag_embed(torch.stack([ratio.sqrt(), ratio.rsqrt()], -1)) @ R.mT
