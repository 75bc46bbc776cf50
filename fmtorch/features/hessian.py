"""Blobs: maxima of the determinant of the Hessian over position and scale (Lindeberg, IJCV 1998)."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.options import Within
from fmtorch.features.extrema import Peaks, refined_maxima
from fmtorch.features.filters import Filters, OpenCVFilters, TorchFilters
from fmtorch.features.frames import upright_frames
from fmtorch.features.sift import as_grey

IMAGE_BLUR = 0.5  # pixels: what a camera leaves; Lowe, IJCV 2004, section 3.3
SMALLEST_OCTAVE = 16  # pixels, the shorter side


@dataclasses.dataclass(frozen=True)
class HessianDetector:
    """Detects bright and dark blobs; an instance may be used by several threads.

    The response is ``sigma^4 (Ixx Iyy - Ixy^2)`` of intensities in [0, 1] in the Gaussian scale space. Octaves are
    halved without interpolation: pixel x of an octave is pixel 2x of the one before. A keypoint is a maximum among its
    26 neighbours, refined by the quadratic through them.

    max_features: the strongest that are kept, over the whole image and all scales. threshold: least response.
    levels: scales per octave. sigma: blur of the first level of an octave, in its pixels; the smallest keypoint has
    ``sigma 2^(1 / (2 levels))``. border: a keypoint closer to the image's border than `border` sigma is dropped.
    """

    max_features: Annotated[int, Within(1)] = 2048
    threshold: float = 1e-4
    levels: int = 3
    sigma: float = 1.6
    border: float = 3.0

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        """Upright frames of half side `FRAME_SIGMAS` sigma and responses, strongest first, through OpenCV's filters.

        image: grey (H, W) or RGB (H, W, 3) uint8. N = 0 where nothing is found. Memory: about 32 bytes a pixel.
        Raises ValueError for another type, shape or an empty image.
        """
        grey = torch.from_numpy(as_grey(image))[None]
        lafs, scores, _ = self._detect(grey.float() / 255, OpenCVFilters())
        return lafs[0], scores[0]

    def detect_batch(
        self, images: Float[Tensor, "b 1 h w"]
    ) -> tuple[Float[Tensor, "b n 2 3"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
        """`detect` for a batch of grey images in [0, 1] on their device: frames, responses, mask.

        Padded with zeros to the image with most keypoints. Equal to `detect` up to the rounding of the filters.
        """
        return self._detect(images[:, 0], TorchFilters())

    def _detect(self, images: Tensor, filters: Filters) -> tuple[Tensor, Tensor, Tensor]:
        by_octave = [
            Peaks(images.new_zeros(0, dtype=torch.int64), images.new_zeros(0, 3).double(), images.new_zeros(0))
        ]
        batch, height, width = images.shape
        spacing = 1.0  # of the octave's pixels in the image
        level = filters.blur(images, math.sqrt(self.sigma**2 - IMAGE_BLUR**2))
        while min(level.shape[1:]) >= SMALLEST_OCTAVE:
            responses, level = self._octave(level, filters)
            seeds = [filters.maxima(responses[:, s], self.threshold) for s in range(1, self.levels + 1)]
            at = [torch.cat([p[:, :1], torch.full_like(p[:, :1], s + 1), p[:, 1:]], 1) for s, p in enumerate(seeds)]
            peaks = refined_maxima(responses, torch.cat(at), self.threshold)
            sigma = self.sigma * 2 ** (peaks.position[:, :1] / self.levels)
            by_octave.append(peaks._replace(position=spacing * torch.cat([sigma, peaks.position[:, 1:]], 1)))
            del responses
            spacing *= 2
        index, position, scores = (torch.cat(parts) for parts in zip(*by_octave, strict=True))
        sigma, y, x = position.unbind(1)
        nearest = torch.stack([x, y, width - 1 - x, height - 1 - y]).amin(0)
        inside = nearest >= self.border * sigma
        lafs = upright_frames(torch.stack([x, y], 1), sigma).float()
        return _strongest(lafs[inside], scores[inside], index[inside], batch, self.max_features)

    def _octave(self, level: Tensor, filters: Filters) -> tuple[Tensor, Tensor]:
        """The responses (B, levels + 2, h, w) of an octave from its first level, and the first level of the next."""
        volume = level.new_empty(level.shape[0], self.levels + 2, *level.shape[1:])
        following = level
        for s in range(self.levels + 2):
            blur = self.sigma * 2 ** (s / self.levels)
            if s > 0:
                before = self.sigma * 2 ** ((s - 1) / self.levels)
                level = filters.blur(level, math.sqrt(blur**2 - before**2))
            if s == self.levels:
                following = level[:, ::2, ::2].contiguous()
            filters.hessian_determinant(level, blur**4, out=volume[:, s])
        return volume, following


def _strongest(
    lafs: Float[Tensor, "m 2 3"], scores: Float[Tensor, " m"], image: Tensor, batch: int, count: int
) -> tuple[Float[Tensor, "b n 2 3"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """The `count` highest scores of each image in falling order, ties in the order given, padded with zeros."""
    order = torch.argsort(scores, descending=True, stable=True)
    chosen = [order[image[order] == i][:count] for i in range(batch)]
    longest = max((len(i) for i in chosen), default=0)
    out_lafs, out_scores = lafs.new_zeros(batch, longest, 2, 3), scores.new_zeros(batch, longest)
    mask = torch.zeros(batch, longest, dtype=torch.bool, device=lafs.device)
    for i, kept in enumerate(chosen):
        out_lafs[i, : len(kept)], out_scores[i, : len(kept)], mask[i, : len(kept)] = lafs[kept], scores[kept], True
    return out_lafs, out_scores, mask
