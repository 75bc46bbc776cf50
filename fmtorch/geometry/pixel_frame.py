"""The frame in which solvers and fits compute: each image's points centred, both in one unit of a power of two pixels.

Rounds nothing but the subtraction of the centre, and depends on a pair's own points only.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import matmul3


class PixelFrame(NamedTuple):
    """Normalised coordinates of P pairs: ``pixel = centre + pixels_per_unit * coordinate``; constants, float64.

    centre: middle of the box around the points of each image, x0, y0, x1, y1. pixels_per_unit: a power of two, so that
    the larger box reaches from about -1 to 1. spread: whether the points differ at all; where not, the unit is a pixel.
    """

    centre: Float[Tensor, "p 4"]
    pixels_per_unit: Float[Tensor, " p"]
    spread: Bool[Tensor, " p"]

    @classmethod
    def around(cls, pixels: Float[Tensor, "p n 4"], mask: Bool[Tensor, "p n"]) -> PixelFrame:
        """The frame of the points in the mask, float64."""
        x, inside = pixels.detach(), mask[..., None]
        if x.shape[1]:
            low = torch.where(inside, x, torch.inf).amin(1)
            high = torch.where(inside, x, -torch.inf).amax(1)
        else:
            low = high = x.new_zeros(len(x), 4)
        nonempty = mask.any(1)
        centre = torch.where(nonempty[:, None], (low + high) / 2, 0)
        half = torch.where(nonempty, ((high - low) / 2).amax(-1), 0)
        spread = half > 0
        half = half.clamp(1e-300, 1e300)
        mantissa = torch.frexp(half).mantissa
        unit = torch.where(mantissa == 0.5, half, half / mantissa)  # the power of two from there up: exact
        return cls(centre, torch.where(spread, unit, 1), spread)

    def normalized(self, pixels: Float[Tensor, "p n 4"]) -> Float[Tensor, "p n 4"]:
        """Points in the frame; attached to the graph of the pixels."""
        return (pixels - self.centre[:, None]) / self.pixels_per_unit[:, None, None]

    def to_pixels(self, F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
        """Fundamental matrices of points in the frame as those of pixels, of any scale."""
        T0, T1 = self._from_pixels(0), self._from_pixels(2)
        return matmul3(matmul3(T1.mT, F), T0)

    def homography_to_pixels(self, H: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
        """Homographies of points in the frame as those of pixels, of any scale."""
        return matmul3(matmul3(self._to_pixels(2), H), self._from_pixels(0))

    def homography_from_pixels(self, H: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
        """Homographies of pixels as those of points in the frame, of any scale."""
        return matmul3(matmul3(self._from_pixels(2), H), self._to_pixels(0))

    def from_pixels(self, F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
        """Fundamental matrices of pixels as those of points in the frame, of any scale."""
        A0, A1 = self._to_pixels(0), self._to_pixels(2)
        return matmul3(matmul3(A1.mT, F), A0)

    def _to_pixels(self, first: int) -> Float[Tensor, "p 1 3 3"]:
        """Maps the frame's points of one image to pixels."""
        unit = self.pixels_per_unit
        A = torch.diag_embed(torch.stack([unit, unit, torch.ones_like(unit)], -1))
        A[:, :2, 2] = self.centre[:, first : first + 2]
        return A[:, None]

    def _from_pixels(self, first: int) -> Float[Tensor, "p 1 3 3"]:
        """Maps pixels of one image to the frame's points."""
        unit = self.pixels_per_unit
        T = torch.diag_embed(torch.stack([1 / unit, 1 / unit, torch.ones_like(unit)], -1))
        T[:, :2, 2] = -self.centre[:, first : first + 2] / unit[:, None]
        return T[:, None]
