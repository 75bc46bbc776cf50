"""Difference-of-Gaussians keypoints with SIFT descriptors, through OpenCV."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Annotated

import cv2
import kornia
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.options import Within
from fmtorch.core.types import Features
from fmtorch.features.frames import FRAME_SIGMAS


@dataclasses.dataclass(frozen=True)
class SIFT:
    """Detects DoG keypoints and describes them by SIFT (Lowe, IJCV 2004); an instance may be used by several threads.

    max_features: the strongest that are kept; a location with several orientations counts once for each.
    contrast_threshold, edge_threshold, sigma: as OpenCV's, see ``conf/features/sift.yaml``.
    precise_upscale: double the image so that pixel x lands on 2x, without the quarter-pixel shift of plain resizing.
    max_pixels: a larger image is reduced to so many pixels first, which bounds memory: OpenCV needs about 240 bytes a
    pixel of the image that it sees.
    root: RootSIFT, the square root of the L1-normalised descriptor (Arandjelovic and Zisserman, CVPR 2012).
    """

    max_features: Annotated[int, Within(1)] = 8000
    contrast_threshold: float = 0.04
    edge_threshold: float = 10.0
    sigma: float = 1.6
    precise_upscale: bool = True
    max_pixels: int = 16_000_000
    root: bool = False

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image; none, with N = 0, where nothing is found.

        lafs: half side `FRAME_SIGMAS` sigma, kornia's angle (minus OpenCV's). scores: contrast. descriptors: (N, 128)
        float32, whole numbers from 0 to 255 unless `root`. Raises ValueError for another type, shape or an empty image.
        """
        grey = as_grey(image)
        seen = self._reduced(grey)
        keypoints, computed = self._opencv().detectAndCompute(seen, None)
        descriptors = np.zeros((0, 128), np.float32) if computed is None else computed
        lafs, scores, kept = self._kept(keypoints, seen.shape, grey.shape)
        features = torch.from_numpy(descriptors[kept])
        return Features(
            lafs=lafs,
            scores=scores,
            descriptors=root_sift(features) if self.root else features,
            image_size=torch.tensor(grey.shape, dtype=torch.int64),
        )

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        """The frames and scores of the features that a call finds, without their descriptors."""
        grey = as_grey(image)
        seen = self._reduced(grey)
        lafs, scores, _ = self._kept(self._opencv().detect(seen), seen.shape, grey.shape)
        return lafs, scores

    def _opencv(self) -> cv2.SIFT:
        return cv2.SIFT.create(
            nfeatures=self.max_features,
            contrastThreshold=self.contrast_threshold,
            edgeThreshold=self.edge_threshold,
            sigma=self.sigma,
            enable_precise_upscale=self.precise_upscale,
        )

    def _reduced(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image, or a smaller one of at most `max_pixels`."""
        factor = math.sqrt(self.max_pixels / grey.size)
        if factor >= 1:
            return grey
        h, w = (max(int(side * factor), 1) for side in grey.shape)
        return cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]

    def _kept(
        self, keypoints: Sequence[cv2.KeyPoint], seen: tuple[int, ...], shape: tuple[int, ...]
    ) -> tuple[Tensor, Tensor, NDArray[np.int64]]:
        """The frames and scores of the strongest keypoints, and which these are; from the image seen to the image."""
        scores = np.array([k.response for k in keypoints], np.float32)
        kept = strongest(scores, self.max_features)
        lafs = keypoints_to_lafs([keypoints[i] for i in kept])
        if seen != shape:
            factor = torch.tensor([shape[1] / seen[1], shape[0] / seen[0]])
            half = torch.tensor([0.0, 0.0, 0.5])  # a pixel's centre is half a pixel from the image's corner
            lafs = (lafs + half) * factor[:, None] - half
        return lafs, torch.from_numpy(scores[kept]), kept


def keypoints_to_lafs(keypoints: Sequence[cv2.KeyPoint]) -> Float[Tensor, "n 2 3"]:
    """OpenCV's keypoints as local affine frames.

    The half side is `FRAME_SIGMAS` times half of `size`, which is a diameter; kornia's angle is minus OpenCV's.
    """
    table = np.array([(*k.pt, k.size, k.angle) for k in keypoints], np.float32).reshape(-1, 4)
    xy, size, angle = torch.tensor_split(torch.from_numpy(table), (2, 3), dim=1)
    if len(table) == 0:
        return torch.zeros(0, 2, 3)
    half_side = FRAME_SIGMAS * size / 2
    lafs: Tensor = kornia.feature.laf_from_center_scale_ori(xy[None], half_side[None, :, :, None], -angle[None])[0]
    return lafs


def root_sift(descriptors: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n d"]:
    """Square root of the L1-normalised descriptor: Euclidean distance becomes the Hellinger distance."""
    total = descriptors.sum(-1, keepdim=True)
    return (descriptors / torch.where(total > 0, total, 1.0)).sqrt()


def strongest(scores: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Indices, in order, of the `count` highest scores: OpenCV keeps more where the last ones tie."""
    return np.sort(np.argsort(-scores, kind="stable")[:count])


def as_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A grey image of a grey or RGB one. Raises ValueError for another type, shape or an empty image."""
    if image.dtype != np.uint8 or image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"image is {image.dtype} {image.shape}; it must be a non-empty uint8 (H, W) or RGB (H, W, 3)")
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)  # type: ignore[return-value]
