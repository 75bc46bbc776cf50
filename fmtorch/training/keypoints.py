"""Keypoints for training patches: DoG by OpenCV's SIFT, and maxima of the determinant of the Hessian."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Matrix = NDArray[np.float64]
Keypoints = Matrix  # (n, 4): x, y, sigma in pixels, angle in radians, x axis towards y axis

BINS = 36
WEAKEST = 1e-4  # response of the Hessian, for intensities in [0, 1]; below it is noise


def dog_keypoints(image: Grey, count: int) -> Keypoints:
    """The strongest DoG keypoints with their dominant orientations (Lowe, IJCV 2004)."""
    detected = cv2.SIFT.create(nfeatures=count, contrastThreshold=0.02, enable_precise_upscale=True).detect(image, None)
    table = np.array([(*k.pt, k.size / 2, math.radians(k.angle)) for k in detected], np.float64)
    return table.reshape(-1, 4)[:count]


def hessian_keypoints(image: Grey, count: int, levels: int = 3) -> Keypoints:
    """The strongest maxima in space and scale of the scale-normalised determinant of the Hessian, to whole pixels.

    levels: scales an octave. The orientation is the main peak of the gradients' histogram, as in SIFT.
    """
    rows = []
    octave: NDArray[np.float32] = np.asarray(image, np.float32) / np.float32(255)
    factor, blur = 1.0, 0.5
    while min(octave.shape) >= 32:
        sigmas = [1.6 * 2 ** (i / levels) for i in range(levels + 2)]
        smooth = [_blurred(octave, math.sqrt(s**2 - blur**2)) for s in sigmas]
        response = np.stack([_hessian(g, sigma) for g, sigma in zip(smooth, sigmas, strict=True)])
        local = np.stack([cv2.dilate(level, np.ones((3, 3), np.uint8)) for level in response])
        for i in range(1, levels + 1):
            peak = (response[i] >= local[i - 1 : i + 2].max(0)) & (response[i] > WEAKEST)
            peak[:4], peak[-4:], peak[:, :4], peak[:, -4:] = False, False, False, False
            y, x = np.nonzero(peak)
            angle = _orientation(smooth[i], x, y, sigmas[i])
            rows.append(np.c_[x * factor, y * factor, np.full(len(x), sigmas[i] * factor), angle, response[i][y, x]])
        octave, factor, blur = smooth[levels - 1][::2, ::2], factor * 2, sigmas[levels - 1] / 2
    table = np.concatenate([np.zeros((0, 5)), *rows])
    return table[np.argsort(-table[:, 4], kind="stable")[:count], :4]


def _blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)


def _hessian(g: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    xx, yy = (cv2.filter2D(g, -1, k) for k in (np.array([[1.0, -2, 1]]), np.array([[1.0], [-2], [1]])))
    xy = cv2.filter2D(g, -1, np.array([[1.0, 0, -1], [0, 0, 0], [-1, 0, 1]]) / 4)
    return np.asarray((xx * yy - xy * xy) * sigma**4, np.float32)


def _orientation(image: NDArray[np.float32], x: NDArray[np.int64], y: NDArray[np.int64], sigma: float) -> Matrix:
    """Main peak of the histogram of gradients within 3 x 1.5 sigma, in radians."""
    radius = round(4.5 * sigma)
    dx, dy = np.zeros_like(image), np.zeros_like(image)
    dx[:, 1:-1], dy[1:-1] = image[:, 2:] - image[:, :-2], image[2:] - image[:-2]
    v, u = (axis.astype(np.int64) for axis in np.mgrid[-radius : radius + 1, -radius : radius + 1].reshape(2, -1))
    weight = np.exp(-(u**2 + v**2) / (2 * (1.5 * sigma) ** 2))
    rows, columns = y[:, None] + v, x[:, None] + u
    inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    gx, gy = dx[rows, columns], dy[rows, columns]
    strength = np.hypot(gx, gy) * weight * inside
    bins = np.round(np.arctan2(gy, gx) * BINS / (2 * np.pi)).astype(np.int64) % BINS
    flat = (np.arange(len(x))[:, None] * BINS + bins).ravel()
    histogram: Matrix = np.bincount(flat, strength.ravel(), len(x) * BINS).astype(np.float64).reshape(-1, BINS)
    for _ in range(2):
        histogram = (np.roll(histogram, 1, 1) + histogram + np.roll(histogram, -1, 1)) / 3
    best = histogram.argmax(1)
    left, centre, right = (histogram[np.arange(len(x)), (best + i) % BINS] for i in (-1, 0, 1))
    curvature = left - 2 * centre + right
    shift = np.where(curvature < 0, 0.5 * (left - right) / np.where(curvature < 0, curvature, -1.0), 0.0)
    return (best + shift) * (2 * np.pi / BINS)  # type: ignore[no-any-return]
