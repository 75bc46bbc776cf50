"""Scores of one hypothesis, match by match, from the definitions."""

from __future__ import annotations

import math

import numpy as np


def sampson(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> float:
    """The Sampson distance of one match (Hartley & Zisserman 2004, equation 11.9)."""
    h0, h1 = np.append(x0, 1.0), np.append(x1, 1.0)
    line1, line0 = F @ h0, F.T @ h1
    return abs(h1 @ line1) / math.sqrt(line1[0] ** 2 + line1[1] ** 2 + line0[0] ** 2 + line0[1] ** 2)


def msac(residuals: np.ndarray, threshold: float, prior: np.ndarray | None = None) -> float:
    """Sum of 1 - r^2 / t^2 over the matches within t, times the prior."""
    weights = np.ones(len(residuals)) if prior is None else prior
    return sum(w * (1 - (r / threshold) ** 2) for r, w in zip(residuals, weights, strict=True) if r < threshold)


def geman_mcclure(residuals: np.ndarray, scale: float, reach: float, prior: np.ndarray | None = None) -> float:
    """Sum of (1 / (1 + r^2 / s^2) - e) / (1 - e) over the matches within `reach` scales, e the value there."""
    weights = np.ones(len(residuals)) if prior is None else prior
    end = 1 / (1 + reach**2)
    inside = [(r, w) for r, w in zip(residuals, weights, strict=True) if r < reach * scale]
    return sum(w * (1 / (1 + (r / scale) ** 2) - end) / (1 - end) for r, w in inside)


def saturated(
    residuals: np.ndarray, points: np.ndarray, scale: float, reach: float, cells: int, prior: np.ndarray
) -> float:
    """Over both images, the sum over the cells of a grid of the root of `geman_mcclure` of the matches in it.

    points: (4, n), x0, y0, x1, y1. The grid is that of the matches' bounding box.
    """
    low, extent = points.min(1, keepdims=True), np.ptp(points, axis=1, keepdims=True)
    cell = np.clip((points - low) / extent * cells, 0, cells - 1).astype(int)
    total = 0.0
    for rows in ((0, 1), (2, 3)):
        for where in {tuple(column) for column in cell[rows, :].T}:
            inside = (where == cell[rows, :].T).all(1)
            total += math.sqrt(geman_mcclure(residuals[inside], scale, reach, prior[inside]))
    return total


def lower_median(values: np.ndarray) -> float:
    """The lower of the middle values."""
    return sorted(values)[(len(values) + 1) // 2 - 1]


def draws_for_confidence(inlier_ratio: float, size: int, confidence: float) -> float:
    """How many samples until one is all inliers with this probability."""
    return math.log(1 - confidence) / math.log(1 - inlier_ratio**size)
