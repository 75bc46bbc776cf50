"""Local affine frames (N, 2, 3) in kornia's convention, and square patches cut along them, without aliasing, batched.

Column 2 of a frame is the centre, columns 0 and 1 are the patch's half axes."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

Image = NDArray[np.uint8]

FRAME_SIGMAS = 6.0
"""Half the side of a local affine frame in units of the keypoint's sigma, which is half of OpenCV's `size`.

The frame is the region from which a 32 x 32 patch is cut for shape, orientation and description (Mishkin et al.,
ECCV 2018); a ratio of two frames' scales is the ratio of the keypoints' sizes.
"""


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
    ``A = U R`` with U lower triangular (Perdoch et al., CVPR 2009: the gravity vector stays vertical)."""
    (a, b), (c, d) = (row.unbind(-1) for row in lafs[..., :2].unbind(-2))
    width = (a * a + b * b).sqrt()
    shear = (a * c + b * d) / width
    height = (a * d - b * c).abs() / width
    first, second = torch.stack([width, shear], -1), torch.stack([torch.zeros_like(width), height], -1)
    return torch.stack([first, second, lafs[..., 2]], -1)


PATCH = 32  # pixels, the side that the networks take
COARSEST = 8  # pixels, the least shorter side of a level
# A level has a blur of about 0.7 of its pixels (the binomial filter's 0.58, and the interpolation's): samples up to
# sqrt(2) of its pixels apart see it with a blur of half their distance, as an image's pixels see a scene.
LARGEST_STEP = math.sqrt(2)
BAND = 32.0  # pixels of the image, rows whose frames are sampled together
MAX_SAMPLES = 8  # along an axis for one pixel of a patch


class ImagePyramid:
    """Images in [0, 1] of a grey image (H, W), each half the size of the one before.
    Pixel x of a level is pixel 2x of the finer one."""

    def __init__(self, grey: Image) -> None:
        self.levels = [torch.from_numpy(np.multiply(grey, 1 / 255, dtype=np.float32))]
        while min(self.levels[-1].shape) >= 2 * COARSEST:
            coarser = cv2.pyrDown(self.levels[-1].numpy(), borderType=cv2.BORDER_REPLICATE)
            self.levels.append(torch.from_numpy(np.asarray(coarser)))

    def extract(self, lafs: Float[Tensor, "n 2 3"], size: int = PATCH) -> Float[Tensor, "n 1 size size"]:
        """Patches in [0, 1] whose pixels tile the frames' squares; the image's border is continued outside.
        Pixel (i, j) shows ``c + A (u_j, u_i)`` with ``u_k = (2 k + 1) / size - 1``: kornia's convention. Its value is
        interpolated in the level in which pixels along the patch's denser axis are at most `LARGEST_STEP` apart, and
        averaged over as many samples along the other axis as keep them so close. Frames not finite give zeros."""
        plan, images = _plan(lafs, len(self.levels), size), [level.numpy() for level in self.levels]
        out = np.zeros((len(lafs), size, size), np.float32)
        flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
        order = _by_place(lafs, plan[0])
        maps, places = _maps(lafs, *plan, size)[order].numpy(), zip(*(a[order].tolist() for a in plan), strict=True)
        for i, matrix, (level, (nx, ny)) in zip(order.tolist(), maps, places, strict=True):
            shape, dense = (size * nx, size * ny), out[i] if nx == ny == 1 else None
            samples = cv2.warpAffine(images[level], matrix, shape, dst=dense, flags=flags, borderMode=border)
            if dense is None:
                cv2.resize(samples, (size, size), dst=out[i], interpolation=cv2.INTER_AREA)
        return torch.from_numpy(out)[:, None]


def _plan(lafs: Tensor, levels: int, size: int) -> tuple[Int[Tensor, " n"], Int[Tensor, "n 2"]]:
    """The pyramid's level of each frame, -1 of one that is not finite, and the samples along (x, y) of a pixel."""
    step = torch.linalg.vector_norm(lafs[..., :2], dim=1) * (2 / size)
    finite = torch.isfinite(lafs).all(2).all(1)
    step = torch.where(finite[:, None], step, 1.0)
    level = (step.amin(1) / LARGEST_STEP).clamp(min=1e-6).log2().ceil().clamp(0, levels - 1)
    samples = (step / (LARGEST_STEP * torch.exp2(level))[:, None]).ceil().clamp(1, MAX_SAMPLES)
    return torch.where(finite, level, -1.0).long(), samples.long()


def _maps(lafs: Tensor, level: Tensor, samples: Tensor, size: int) -> Float[Tensor, "n 2 3"]:
    """From the samples' columns and rows, counted from 0, to pixels of the level (float64)."""
    lafs = lafs.double()
    step = lafs[..., :2] * (2 / (size * samples))[:, None, :]
    first = lafs[..., 2] - lafs[..., :2].sum(-1) + 0.5 * step.sum(-1)
    return torch.cat([step, first[..., None]], -1) / torch.exp2(level.double())[:, None, None]


def _by_place(lafs: Float[Tensor, "n 2 3"], level: Int[Tensor, " n"]) -> Int[Tensor, " m"]:
    """The finite frames, neighbours in the image after one another: what they see is then in the cache already."""
    finite = torch.nonzero(level >= 0)[:, 0]
    x, y = lafs[finite, 0, 2], lafs[finite, 1, 2]
    by_column = x.argsort()
    return finite[by_column[(y[by_column] / BAND).floor().argsort(stable=True)]]
