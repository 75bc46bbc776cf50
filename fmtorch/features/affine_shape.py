"""Affine shape of local frames by AffNet (Mishkin, Radenovic, Matas, ECCV 2018)."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.features.frames import frame_scale, make_upright
from fmtorch.features.orientation import PatchFunction
from fmtorch.features.patches import ImagePyramid

LONGEST = 6.0  # largest ratio of a region's axes; Perdoch et al., CVPR 2009, give up on longer ones


@dataclasses.dataclass(frozen=True)
class NetworkShape:
    """Gives frames the affine shape that a network sees in their upright patches.

    network: patches (N, 1, 32, 32) -> (N, 3), the shape [[1 + x0, 0], [x1, 1 + x2]] in the patch's coordinates.
    """

    network: PatchFunction

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 3"]:
        """Upright frames of the same centres and areas with the new shape.

        A frame keeps its shape where the new one is singular, not finite, or longer than `LONGEST`.
        """
        upright = make_upright(lafs)
        if len(lafs) == 0:
            return upright
        x0, x1, x2 = self.network(pyramid.extract(upright)).to(lafs).unbind(1)
        zero = torch.zeros_like(x0)
        shape = torch.stack([torch.stack([1 + x0, zero], 1), torch.stack([x1, 1 + x2], 1)], 1)
        first, second, centre = upright.unbind(-1)
        columns = [first * shape[:, :1, k] + second * shape[:, 1:, k] for k in (0, 1)]
        shaped = make_upright(torch.stack([*columns, centre], -1))
        shaped = _rescaled(shaped, frame_scale(upright) / frame_scale(shaped))
        valid = torch.isfinite(shaped).all(2).all(1) & (_elongation(shaped) <= LONGEST)
        return torch.where(valid[:, None, None], shaped, upright)


def _rescaled(lafs: Tensor, factor: Tensor) -> Tensor:
    return torch.cat([lafs[..., :2] * factor[:, None, None], lafs[..., 2:]], -1)


def _elongation(lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, " n"]:
    """Ratio of the axes of the ellipse that a frame makes of the unit circle."""
    scale = frame_scale(lafs)
    half_sum = 0.5 * lafs[..., :2].square().sum((1, 2)) / (scale * scale)  # of the squared axes a^2 + 1 / a^2
    return half_sum + (half_sum * half_sum - 1).clamp(min=0).sqrt()
