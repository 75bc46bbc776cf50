"""Agreement of local affine frames and of positions, match by match, from the definitions."""

import itertools
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


def similarity(p0: np.ndarray, p1: np.ndarray, curves: Sequence[Any], turns: int, scales: Any) -> np.ndarray:
    """The common turn and scale as maps (N, 2, 2): the best bin of the product of both images' smoothed histograms."""
    product = np.ones((len(scales), turns))
    for points in (p0, p1):
        order = morton_order(points, *curves[0])
        votes = np.zeros((len(scales), turns))
        for i, j in itertools.pairwise(order):
            d, u = complex(*(p0[j] - p0[i])), complex(*(p1[j] - p1[i]))
            if d == 0 or u == 0:
                continue
            level = round(2 * np.log2(abs(u / d))) + len(scales) // 2
            if 0 <= level < len(scales):
                votes[level, round(np.angle(u / d) / (2 * np.pi) * turns) % turns] += 1
        votes = 2 * votes + np.roll(votes, 1, 1) + np.roll(votes, -1, 1)
        smooth = 2 * votes
        smooth[1:] += votes[:-1]
        smooth[:-1] += votes[1:]
        product *= smooth
    bins, identity = product.size, len(scales) // 2 * turns
    best = max(range(bins), key=lambda i: (product.flat[i], -((identity - i) % bins)))  # the identity, of equals
    S = scales[best // turns] * np.exp(2j * np.pi * (best % turns) / turns)
    return np.tile([[S.real, -S.imag], [S.imag, S.real]], (len(p0), 1, 1))
