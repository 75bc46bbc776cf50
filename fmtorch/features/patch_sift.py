"""SIFT of patches, plain, as RootSIFT, and pooled over domain sizes; batched (Lowe, IJCV 2004, section 6)."""

from __future__ import annotations

import dataclasses
import functools
import math

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.features.frames import FRAME_SIGMAS
from fmtorch.features.patches import PATCH, ImagePyramid
from fmtorch.features.sift import root_sift

CELLS, DIRECTIONS = 4, 8  # a grid of 4 x 4 histograms of 8 directions
CELL_SIGMAS = 3.0  # side of a cell in keypoint sigmas: vl_sift's magnification
EXTENT = CELL_SIGMAS * (CELLS + 1) / 2 / FRAME_SIGMAS  # half side of the patch in frames: votes reach half a cell on
WINDOW = CELLS / 2  # cells, sigma of the Gaussian window; Lowe, section 6.1
CLIP = 0.2  # largest entry of the normalised histogram; Lowe, section 6.1
SMOOTHING = 1.0  # keypoint sigmas, the blur at which gradients are taken: that of the level of detection
PATCH_BLUR = 0.75  # pixels, the blur that patches have from the pyramid
FLAT = 1e-6  # gradients below are the rounding of float32 intensities
CHUNK = 64  # patches worked on together: their histograms fit a core's cache


@dataclasses.dataclass(frozen=True)
class PatchSIFT:
    """SIFT descriptors of frames; with several `sizes` the mean over them, DSP-SIFT (Dong and Soatto, CVPR 2015).

    root: RootSIFT (Arandjelovic and Zisserman, CVPR 2012) of each. smallest, largest: the range of domain sizes, in
    units of the frame. sizes: how many are sampled in it, evenly, both ends included.
    """

    root: bool = False
    smallest: float = 1.0
    largest: float = 1.0
    sizes: int = 1

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 128"]:
        """Descriptors of unit length; zeros for a frame without gradient. In OpenCV's order."""
        total = lafs.new_zeros(len(lafs), CELLS * CELLS * DIRECTIONS)
        for size in torch.linspace(self.smallest, self.largest, self.sizes).tolist():
            scaled = torch.cat([lafs[..., :2] * (EXTENT * size), lafs[..., 2:]], -1)
            described = sift_of_patches(pyramid.extract(scaled))
            total = total + (root_sift(described) if self.root else described)
        return total if self.sizes == 1 else normalized(total)


def sift_of_patches(patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n 128"]:
    """SIFT of patches that cover `EXTENT` frames: gradients of the blurred patch vote, weighted by a Gaussian window.

    Each gradient votes for the two nearest directions and the four nearest cells; the histogram is normalised, clipped
    and normalised again. Entry (4 y + x) 8 + d is cell (x, y), direction 45 d degrees counter-clockwise on the screen.
    """
    pooling, along, across = _matrices(patches.device)
    parts = []
    for part in torch.split(patches[:, 0], CHUNK):
        gx = across @ part @ along.T
        gy = along @ part @ across.T
        squared = (gx * gx + gy * gy).flatten(1)
        magnitude = torch.where(squared > FLAT * FLAT, squared, 0.0).sqrt()
        position = (torch.atan2(-gy, gx) * (DIRECTIONS / (2 * math.pi))).flatten(1)
        lower = position.floor()
        upper_weight = (position - lower) * magnitude
        lower_bin = lower.long() & (DIRECTIONS - 1)
        votes = part.new_zeros(len(part), DIRECTIONS, PATCH * PATCH)
        votes.scatter_(1, lower_bin[:, None], (magnitude - upper_weight)[:, None])
        votes.scatter_(1, ((lower_bin + 1) & (DIRECTIONS - 1))[:, None], upper_weight[:, None])
        parts.append((votes @ pooling).transpose(1, 2).flatten(1))
    histogram = torch.cat(parts) if parts else patches.new_zeros(0, CELLS * CELLS * DIRECTIONS)
    return normalized(normalized(histogram).clamp(max=CLIP))


def normalized(x: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Rows of unit length; zero rows stay zero."""
    norm = torch.linalg.vector_norm(x, dim=1, keepdim=True)
    return x / torch.where(norm > 0, norm, 1.0)


@functools.cache
def _matrices(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Pooling (1024, 16) of the pixels' votes; blur with derivative, and blur, along an axis (32, 32)."""
    sigma_pixels = PATCH / (2 * EXTENT * FRAME_SIGMAS)  # a keypoint sigma
    x = torch.arange(PATCH, dtype=torch.float64)
    cell = CELL_SIGMAS * sigma_pixels
    centred = (x - (PATCH - 1) / 2) / cell
    centres = torch.arange(CELLS, dtype=torch.float64) - (CELLS - 1) / 2
    weight = (1 - (centred[:, None] - centres).abs()).clamp(min=0) * torch.exp(-0.5 * (centred / WINDOW) ** 2)[:, None]
    pooling = torch.einsum("yi,xj->yxij", weight, weight).reshape(PATCH * PATCH, CELLS * CELLS)
    sigma = math.sqrt(max((SMOOTHING * sigma_pixels) ** 2 - PATCH_BLUR**2, 1e-6))
    blur = torch.exp(-0.5 * ((x[:, None] - x) / sigma) ** 2)
    blur = torch.where(blur > 1e-8, blur, 0.0)  # denormal numbers would make the products ten times slower
    blur = blur / blur.sum(1, keepdim=True)
    derivative = torch.zeros(PATCH, PATCH, dtype=torch.float64)
    inner = torch.arange(1, PATCH - 1)
    derivative[inner, inner + 1], derivative[inner, inner - 1] = 0.5, -0.5
    return pooling.float().to(device), (derivative @ blur).float().to(device), blur.float().to(device)
