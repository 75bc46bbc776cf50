"""Images of known calibration as those of a camera with square pixels and a central principal point.

``x' = K' K^-1 x`` with ``K' = [f 0 (w-1)/2; 0 f (h-1)/2; 0 0 1]``: all that may then be unknown is a focal length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.geometry.arithmetic import sqrt

MIN_FOCAL, MAX_FOCAL = 0.1, 10.0  # in units of the longer side; K of other focal lengths is of another unit or image
MIN_SIDE_PX, MAX_SIDE_PX = 16.0, 1e6  # longer sides, or focal lengths, of coordinates that are pixels
NOMINAL_FOCAL_PX = 1000.0  # of the image that points of another unit, such as normalised ones, are mapped to
USUAL_FOCAL = 1.2  # in units of the longer side, where neither size nor principal point tells that


class SquarePixels(NamedTuple):
    """The images that B images are mapped to.

    map: from coordinates of K to those of K', attached to K; that of a faulty K is the identity. focal: of K', px,
    constant. size: (h, w), px. unit: the focal length of K in that of K', attached.
    """

    map: Float[Tensor, "b 3 3"]
    focal: Float[Tensor, " b"]
    size: Float[Tensor, "b 2"]
    unit: Float[Tensor, " b"]


def square_pixels(
    K: Float[Tensor, "b 3 3"], size: Real[Tensor, "b 2"] | None, valid: Bool[Tensor, " b"]
) -> SquarePixels:
    """Square pixels of the focal length f = sqrt(fx fy) of K; skew is allowed. Float64.

    Args:
        K: calibration matrices (B, 3, 3), rows (fx, s, cx), (0, fy, cy), (0, 0, 1).
        size: (B, 2), (h, w) in the unit of K. None: twice the principal point, or where that is none of an image, as of
            normalised points, a square around it of the usual focal length.
        valid: (B,), where `calibration_problems` has nothing to say.

    Returns:
        `SquarePixels`. Where the longer side (or, if that is not known, the focal length) is not within MIN_SIDE_PX and
        MAX_SIDE_PX, the unit is not a pixel, and points are mapped to an image of a focal length of NOMINAL_FOCAL_PX.
    """
    K = torch.where(valid[:, None, None], K.to(torch.float64), torch.eye(3, dtype=torch.float64, device=K.device))
    K = K / K[:, 2:, 2:]
    fx, skew, cx, fy, cy = K[:, 0, 0], K[:, 0, 1], K[:, 0, 2], K[:, 1, 1], K[:, 1, 2]
    focal, image, in_pixels = _image(K.detach(), size)
    scale = torch.where(~in_pixels, NOMINAL_FOCAL_PX / focal, 1.0)
    f, image = focal * scale, image * scale[:, None]
    x, y = (image[:, 1] - 1) / 2, (image[:, 0] - 1) / 2
    zero, ones = torch.zeros_like(fx), torch.ones_like(fx)
    across = -f * skew / (fx * fy)
    rows = [f / fx, across, x - f / fx * cx - across * cy, zero, f / fy, y - f / fy * cy, zero, zero, ones]
    A = torch.where(valid[:, None], torch.stack(rows, -1), torch.eye(3, dtype=K.dtype, device=K.device).flatten())
    return SquarePixels(A.reshape(-1, 3, 3), f, image, sqrt(fx * fy) / f)


def _image(K: Tensor, size: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Focal lengths and sizes in the unit of K, and whether that is a pixel."""
    focal = sqrt(K[:, 0, 0] * K[:, 1, 1])
    if size is not None:
        image = size.to(torch.float64)
        return focal, image, (image.amax(1) >= MIN_SIDE_PX) & (image.amax(1) <= MAX_SIDE_PX)
    centre = K[:, [1, 0], 2]
    longest = centre.amax(1) * 2 + 1
    central = (centre > 0).all(1) & (longest * MIN_FOCAL < focal) & (focal < longest * MAX_FOCAL)
    square = (focal / USUAL_FOCAL)[:, None].expand(-1, 2)
    in_pixels = (focal >= MIN_SIDE_PX) & (focal <= MAX_SIDE_PX)
    return focal, torch.where(central[:, None], 2 * centre + 1, square), in_pixels


def calibration_problems(
    K: Float[Tensor, "b 3 3"], size: Real[Tensor, "b 2"] | None, name: str = "K"
) -> tuple[str, ...]:
    """Why each K (B, 3, 3) is no calibration matrix of an image of its size (B, 2); empty where it may be one.

    Args:
        K: calibration matrices.
        size: (h, w) in the unit of K, None where unknown.
        name: of the argument that K is, with which a reason begins.
    """
    sizes = [None] * len(K) if size is None else size.detach().cpu().double().numpy()
    return tuple(_problem(k, s, name) for k, s in zip(K.detach().cpu().double().numpy(), sizes, strict=True))


def _problem(K: NDArray[np.float64], size: NDArray[np.float64] | None, name: str) -> str:
    if not np.isfinite(K).all():
        return f"{name} is not finite"
    if 0 in (K[0, 0], K[1, 1], K[2, 2]):
        return f"{name} is singular; its rows must be (fx, s, cx), (0, fy, cy), (0, 0, 1)"
    K = K / K[2, 2]
    if K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0:
        return f"{name} is {K.tolist()}; its rows must be (fx, s, cx), (0, fy, cy), (0, 0, 1)"
    if K[0, 0] < 0 or K[1, 1] < 0:
        return f"{name} has focal lengths {K[0, 0]:g}, {K[1, 1]:g}; they must be positive"
    if size is None or not (size > 0).all():
        return ""
    (h, w), focal = size.tolist(), float(np.sqrt(K[0, 0]) * np.sqrt(K[1, 1]))
    if not MIN_FOCAL * max(h, w) <= focal:
        return f"{name} has a focal length of {focal:g} for an image of {w:g} x {h:g} pixels; it must be in pixels"
    if not (-0.5 <= K[0, 2] <= w - 0.5 and -0.5 <= K[1, 2] <= h - 0.5):
        return (
            f"{name} has the principal point ({K[0, 2]:g}, {K[1, 2]:g}), outside the image of {w:g} x {h:g} pixels; "
            "it must be of an image of that size"
        )
    return ""


def mapped(x: Float[Tensor, "*batch n 2"], A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch n 2"]:
    """Points (..., N, 2) by affine maps (..., 3, 3), in the points' type."""
    rows = A[..., None, :2, :]
    return (rows[..., 0] * x[..., :1] + rows[..., 1] * x[..., 1:] + rows[..., 2]).to(x.dtype)
