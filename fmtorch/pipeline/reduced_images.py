"""Images reduced for matching, and what was found in them in pixels of the originals."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.geometry.epipolar import unit_frobenius

Image = NDArray[np.uint8]


def reduced_image(image: Image, longest_side: int) -> tuple[Image, Float[Tensor, " xy"]]:
    """The image with its longest side at most that long, and its scale in x and y (rounding makes them differ)."""
    h, w = image.shape[:2]
    scale = min(1.0, longest_side / max(h, w))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    if size != (w, h):
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image, torch.tensor([size[0] / w, size[1] / h], dtype=torch.float64)


def to_original(x: Tensor, s: Tensor) -> Tensor:
    """Points of a reduced image in pixels of the original; exactly x where nothing was reduced."""
    return x / s + (1 - s) / (2 * s)


def frames_to_original(lafs: Float[Tensor, "*batch 2 3"] | None, s: Tensor) -> Float[Tensor, "*batch 2 3"] | None:
    """Local affine frames of a reduced image in pixels of the original."""
    if lafs is None:
        return None
    return torch.cat([lafs[..., :2] / s[:, None], to_original(lafs[..., 2:].mT, s).mT], -1)


def fundamental_to_original(F: Float[Tensor, "3 3"], s0: Tensor, s1: Tensor) -> Float[Tensor, "3 3"]:
    """F between two reduced images in pixels of the originals, of unit Frobenius norm."""
    # (0, 0) is the centre of the first pixel, so x_reduced + 1/2 = s (x + 1/2).
    A0, A1 = (
        torch.tensor([[s[0], 0, (s[0] - 1) / 2], [0, s[1], (s[1] - 1) / 2], [0, 0, 1]], dtype=torch.float64).to(F)
        for s in (s0, s1)
    )
    return unit_frobenius(A1.T @ F @ A0)
