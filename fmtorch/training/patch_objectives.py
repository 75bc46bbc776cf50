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

from fmtorch import random
from fmtorch.random import Stream
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
    """Descriptors of a point's two patches should be nearer than those of different points: `criterion` says how."""

    criterion: Callable[[Tensor, Tensor], Tensor]

    def loss(self, network: nn.Module, pairs: Float[Tensor, "2 n 1 h w"], draws: Float[Tensor, "n k"]) -> Tensor:
        """The criterion on both patches of each point, mirrored and turned alike at random."""
        patches = middle(pairs)
        left, up, over = (draws[:, column, None, None, None] < 0.5 for column in range(3))
        patches = torch.where(left, patches.flip(-1), patches)
        patches = torch.where(up, patches.flip(-2), patches)
        patches = torch.where(over, patches.mT, patches)
        a, b = network(patches.flatten(0, 1)).chunk(2)
        return self.criterion(a, b)

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


def _rotation(angle: Float[Tensor, " n"]) -> Float[Tensor, "n 2 2"]:
    c, s = angle.cos(), angle.sin()
    return torch.stack([c, -s, s, c], -1).reshape(-1, 2, 2)


def _stretch(ratio: Float[Tensor, " n"], axis: Float[Tensor, " n"]) -> Float[Tensor, "n 2 2"]:
    """Symmetric matrices of determinant 1 with this ratio of axes, the long one in this direction."""
    R = _rotation(axis)
    return R @ torch.diag_embed(torch.stack([ratio.sqrt(), ratio.rsqrt()], -1)) @ R.mT
