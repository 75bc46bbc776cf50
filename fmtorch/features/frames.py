"""Local affine frames (N, 2, 3) in kornia's convention: column 2 the centre, columns 0 and 1 the patch's half axes."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

FRAME_SIGMAS = 6.0
"""Half the side of a local affine frame in units of the keypoint's sigma, which is half of OpenCV's `size`.

The frame is the region from which a 32 x 32 patch is cut for shape, orientation and description (Mishkin et al.,
ECCV 2018); a ratio of two frames' scales is the ratio of the keypoints' sizes.
"""


def upright_frames(xy: Float[Tensor, "*n 2"], sigma: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2 3"]:
    """Square frames along the image's axes, of half side `FRAME_SIGMAS` sigma."""
    half_side = FRAME_SIGMAS * sigma
    zero = torch.zeros_like(half_side)
    columns = (torch.stack([half_side, zero], -1), torch.stack([zero, half_side], -1), xy)
    return torch.stack(columns, -1)


def frame_scale(lafs: Float[Tensor, "*n 2 3"]) -> Float[Tensor, "*n"]:
    """The half side of the square of equal area, in pixels: the square root of the determinant."""
    determinant: Tensor = lafs[..., 0, 0] * lafs[..., 1, 1] - lafs[..., 0, 1] * lafs[..., 1, 0]
    return determinant.abs().sqrt()


def rotate_frames(lafs: Float[Tensor, "*n 2 3"], angle: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2 3"]:
    """Frames of the same region whose axes are turned by `angle` radians, counter-clockwise on the screen."""
    cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
    first, second, centre = lafs.unbind(-1)
    return torch.stack([first * cosine - second * sine, first * sine + second * cosine, centre], -1)


def make_upright(lafs: Float[Tensor, "*n 2 3"]) -> Float[Tensor, "*n 2 3"]:
    """The frame of the same region and area whose second axis points along the image's y axis.

    ``A = U R`` with U lower triangular (Perdoch et al., CVPR 2009: the gravity vector stays vertical).
    """
    (a, b), (c, d) = (row.unbind(-1) for row in lafs[..., :2].unbind(-2))
    width = (a * a + b * b).sqrt()
    shear = (a * c + b * d) / width
    height = (a * d - b * c).abs() / width
    first, second = torch.stack([width, shear], -1), torch.stack([torch.zeros_like(width), height], -1)
    return torch.stack([first, second, lafs[..., 2]], -1)
