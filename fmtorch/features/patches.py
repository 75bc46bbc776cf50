"""Square patches cut from an image along local affine frames, without aliasing, batched."""

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

Image = NDArray[np.uint8]

PATCH = 32  # pixels, the side that the networks take
COARSEST = 8  # pixels, the least shorter side of a level
# A level has a blur of about 0.7 of its pixels (the binomial filter's 0.58, and the interpolation's): samples up to
# sqrt(2) of its pixels apart see it with a blur of half their distance, as an image's pixels see a scene.
LARGEST_STEP = math.sqrt(2)
BAND = 32.0  # pixels of the image, rows whose frames are sampled together
MAX_SAMPLES = 8  # along an axis for one pixel of a patch


class ImagePyramid:
    """Grey images in [0, 1], each half the size of the one before; pixel x of a level is pixel 2x of the finer one."""

    def __init__(self, grey: Image | Float[Tensor, "h w"]) -> None:
        """Of an image (H, W): uint8 for OpenCV on the CPU, or a tensor in [0, 1] for torch on its device."""
        if isinstance(grey, np.ndarray):
            finest = torch.from_numpy(np.multiply(grey, 1 / 255, dtype=np.float32))
            self.levels, self._halve = [finest], _halve_opencv
        else:
            self.levels, self._halve = [grey], _halve_torch
        while min(self.levels[-1].shape) >= 2 * COARSEST:
            self.levels.append(self._halve(self.levels[-1]))

    def extract(self, lafs: Float[Tensor, "n 2 3"], size: int = PATCH) -> Float[Tensor, "n 1 size size"]:
        """Patches in [0, 1] whose pixels tile the frames' squares; the image's border is continued outside.

        Pixel (i, j) shows ``c + A (u_j, u_i)`` with ``u_k = (2 k + 1) / size - 1``: kornia's convention. Its value is
        interpolated in the level in which pixels along the patch's denser axis are at most `LARGEST_STEP` apart, and
        averaged over as many samples along the other axis as keep them so close. A frame that is not finite gives
        zeros.
        """
        plan = _plan(lafs, len(self.levels), size)
        sample = _sample_opencv if self._halve is _halve_opencv else _sample_torch
        return sample(self.levels, lafs, plan, size)


class _Plan(NamedTuple):
    """Per frame: the pyramid's level, -1 for a frame that is not finite, and the samples along (x, y) of a pixel."""

    level: Int[Tensor, " n"]
    samples: Int[Tensor, "n 2"]


def _plan(lafs: Tensor, levels: int, size: int) -> _Plan:
    step = torch.linalg.vector_norm(lafs[..., :2], dim=1) * (2 / size)
    finite = torch.isfinite(lafs).all(2).all(1)
    step = torch.where(finite[:, None], step, 1.0)
    level = (step.amin(1) / LARGEST_STEP).clamp(min=1e-6).log2().ceil().clamp(0, levels - 1)
    samples = (step / (LARGEST_STEP * torch.exp2(level))[:, None]).ceil().clamp(1, MAX_SAMPLES)
    return _Plan(torch.where(finite, level, -1.0).long(), samples.long())


def _maps(lafs: Tensor, plan: _Plan, size: int) -> Float[Tensor, "n 2 3"]:
    """From the samples' columns and rows, counted from 0, to pixels of the level (float64)."""
    lafs = lafs.double()
    step = lafs[..., :2] * (2 / (size * plan.samples))[:, None, :]
    first = lafs[..., 2] - lafs[..., :2].sum(-1) + 0.5 * step.sum(-1)
    return torch.cat([step, first[..., None]], -1) / torch.exp2(plan.level.double())[:, None, None]


def _halve_opencv(image: Tensor) -> Tensor:
    return torch.from_numpy(np.asarray(cv2.pyrDown(image.numpy(), borderType=cv2.BORDER_REPLICATE)))


def _sample_opencv(levels: list[Tensor], lafs: Tensor, plan: _Plan, size: int) -> Tensor:
    images = [level.numpy() for level in levels]
    out = np.zeros((len(lafs), size, size), np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    order = _by_place(lafs, plan)
    maps, places = _maps(lafs, plan, size)[order].numpy(), zip(*(a[order].tolist() for a in plan), strict=True)
    for i, matrix, (level, (nx, ny)) in zip(order.tolist(), maps, places, strict=True):
        patch = out[i]
        dense = patch if nx == ny == 1 else None
        samples = cv2.warpAffine(
            images[level], matrix, (size * nx, size * ny), dst=dense, flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        if dense is None:
            cv2.resize(samples, (size, size), dst=patch, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(out)[:, None]


def _by_place(lafs: Float[Tensor, "n 2 3"], plan: _Plan) -> Int[Tensor, " m"]:
    """The finite frames, neighbours in the image after one another: what they see is then in the cache already."""
    finite = torch.nonzero(plan.level >= 0)[:, 0]
    x, y = lafs[finite, 0, 2], lafs[finite, 1, 2]
    by_column = x.argsort()
    by_band = (y[by_column] / BAND).floor().argsort(stable=True)
    return finite[by_column[by_band]]


def _halve_torch(image: Tensor) -> Tensor:
    kernel = image.new_tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
    padded = F.pad(image[None, None], (2, 2, 2, 2), mode="replicate")
    rows = F.conv2d(padded, kernel[None, None, None, :], stride=(1, 2))
    return F.conv2d(rows, kernel[None, None, :, None], stride=(2, 1))[0, 0]


def _sample_torch(levels: list[Tensor], lafs: Tensor, plan: _Plan, size: int) -> Tensor:
    out = lafs.new_zeros(len(lafs), 1, size, size, dtype=torch.float32)
    maps = _maps(lafs, plan, size)
    kinds = torch.cat([plan.level[:, None], plan.samples], 1)
    for level, nx, ny in torch.unique(kinds[plan.level >= 0], dim=0).tolist():
        chosen = torch.nonzero((kinds == kinds.new_tensor([level, nx, ny])).all(1))[:, 0]
        image = levels[level]
        h, w = image.shape
        x = torch.arange(size * nx, device=lafs.device, dtype=torch.float64)
        y = torch.arange(size * ny, device=lafs.device, dtype=torch.float64)
        column, row, origin = maps[chosen][:, None, None].unbind(-1)
        pixel = column * x[None, None, :, None] + row * y[None, :, None, None] + origin
        grid = (2 * pixel + 1) / pixel.new_tensor([w, h]) - 1  # grid_sample's coordinates, align_corners=False
        samples = F.grid_sample(
            image[None, None], grid.float().reshape(1, -1, size * nx, 2), padding_mode="border", align_corners=False
        )
        out[chosen] = F.avg_pool2d(samples.reshape(-1, 1, size * ny, size * nx), (ny, nx))
    return out
