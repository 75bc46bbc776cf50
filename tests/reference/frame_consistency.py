"""Agreement of local affine frames, match by match, from the definition."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np


def morton_order(points: np.ndarray, shift: float, angle: float, bits: int = 15) -> list[int]:
    """Indices of the points along a Morton curve over the turned, shifted unit square; float32 as the batched code."""
    x, y = points.astype(np.float32).T
    c, s = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    turned = np.stack([c * x - s * y, s * x + c * y])
    low = turned.min(1, keepdims=True)
    extent = max((turned.max(1, keepdims=True) - low).max(), np.float32(1e-6))
    cell = ((turned - low) / extent * np.float32(2) + np.float32(shift)) / np.float32(3) * np.float32((1 << bits) - 1)

    def code(n: int) -> int:
        u, v = int(cell[0, n]), int(cell[1, n])
        return sum(((u >> b & 1) << (2 * b)) | ((v >> b & 1) << (2 * b + 1)) for b in range(bits + 1))

    return sorted(range(len(points)), key=lambda n: (code(n), n))


def agreement(
    x0: np.ndarray, x1: np.ndarray, S: np.ndarray, vote: np.ndarray, curves: Sequence[Any],
    window: int, tolerance: float, noise: float,
) -> np.ndarray:  # fmt: skip
    """The share of votes that agree with each match; S (N, 2, 2) maps frame 0 to frame 1."""
    total, votes = np.zeros(len(x0)), np.zeros(len(x0))
    for points in (x0, x1):
        for shift, angle in curves:
            order = morton_order(points, shift, angle)
            for place, i in enumerate(order):
                for other in range(max(0, place - window), min(len(order), place + window + 1)):
                    if other == place:
                        continue
                    j = order[other]
                    d0, d1 = x0[j] - x0[i], x1[j] - x1[i]
                    error = max(np.linalg.norm(S[i] @ d0 - d1), np.linalg.norm(S[j] @ d0 - d1))
                    scale = math.sqrt(abs(np.linalg.det(S[i])))
                    e = error / (scale * np.linalg.norm(d0) + np.linalg.norm(d1) + noise)
                    total[i] += vote[j] * (1 + (e / tolerance) ** 2 / 8) ** -8
                    votes[i] += vote[j]
    return total / np.maximum(votes, np.finfo(float).tiny)
