"""The paper's rule for a pair: more than 20 SIFT matches within 1 px of the true epipolar lines in both images.

Bian et al., BMVC 2019, Section 4; SIFT is OpenCV's, matches pass the ratio test from the first image to the second.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SIFT_FEATURES, RATIO, NEAR_LINE, ENOUGH = 8000, 0.8, 1.0, 20
_AT_ONCE = 512  # keypoints that are matched together

Keypoints = tuple[NDArray[np.float64], NDArray[np.float32]]


def keypoints(grey: NDArray[np.uint8]) -> Keypoints:
    """OpenCV's SIFT: points (n, 2) and descriptors (n, 128)."""
    detected, descriptors = cv2.SIFT.create(nfeatures=SIFT_FEATURES).detectAndCompute(grey, np.ones_like(grey))
    if not detected:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    return np.array([k.pt for k in detected], dtype=np.float64), descriptors.astype(np.float32)


def ratio_matches(a: Keypoints, b: Keypoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nearest neighbours from the first image to the second that pass the ratio test: points (n, 2) and (n, 2)."""
    if len(a[0]) == 0 or len(b[0]) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    distance = (a[1] ** 2).sum(1)[:, None] + (b[1] ** 2).sum(1) - 2 * a[1] @ b[1].T
    rows = np.arange(len(distance))
    best = distance.argmin(1)
    first = distance[rows, best].copy()
    distance[rows, best] = np.inf
    good = np.maximum(first, 0) < RATIO**2 * distance.min(1)
    return a[0][good], b[0][best[good]]


def matchable(a: Keypoints, b: Keypoints, F: NDArray[np.float64]) -> bool:
    """Whether more than `ENOUGH` ratio matches lie within `NEAR_LINE` pixels of the true lines in both images.

    Looks at some of the first image's keypoints at a time, until there are enough.
    """
    near = 0
    for begin in range(0, len(a[0]), _AT_ONCE):
        block = a[0][begin : begin + _AT_ONCE], a[1][begin : begin + _AT_ONCE]
        near += _near_lines(*ratio_matches(block, b), F)
        if near > ENOUGH:
            return True
    return False


def _near_lines(x0: NDArray[np.float64], x1: NDArray[np.float64], F: NDArray[np.float64]) -> int:
    """How many matches (n, 2), (n, 2) lie within `NEAR_LINE` pixels of the true lines in both images."""
    h0, h1 = np.column_stack([x0, np.ones(len(x0))]), np.column_stack([x1, np.ones(len(x1))])
    l1, l0 = h0 @ F.T, h1 @ F
    error = np.abs((h1 * l1).sum(1))
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = error / np.minimum(np.hypot(l0[:, 0], l0[:, 1]), np.hypot(l1[:, 0], l1[:, 1]))
    return int((worst < NEAR_LINE).sum())
