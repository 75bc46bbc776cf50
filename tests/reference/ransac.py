"""Scores of one hypothesis, match by match, from the definitions; residuals are in thresholds."""

import math
from collections.abc import Sequence

import numpy as np

from tests.reference.refine import magsac_loss

REACH = 5  # scales, from which on the gain of Geman & McClure is zero


def inlier(r: float) -> float:
    """The gain of RANSAC."""
    return 1.0 if r <= 1 else 0.0


def truncated_square(r: float) -> float:
    """The gain of MSAC."""
    return 1 - r * r if r < 1 else 0.0


def geman_mcclure(r: float) -> float:
    """(1 / (1 + r^2) - e) / (1 - e), e the value at REACH scales; beyond it zero."""
    end = 1 / (1 + REACH**2)
    return (1 / (1 + r * r) - end) / (1 - end) if r < REACH else 0.0


def magsac(r: float) -> float:
    """1 - rho(r) / rho(k sigma_max) of MAGSAC++."""
    loss, max_loss = magsac_loss(np.array([min(r, 1.0) ** 2, 1.0]), 1.0)
    return float(1 - loss / max_loss)


def rounded(value: float, bits: int) -> float:
    """The nearest multiple of 2^-bits."""
    return round(value * 2**bits) / 2**bits


def summed(gains: Sequence[float], weights: Sequence[float], bits: int) -> float:
    """The sum of rounded gains times weights."""
    return sum(rounded(g * w, bits) for g, w in zip(gains, weights, strict=True))


def saturated(gains: Sequence[float], weights: Sequence[float], cells: np.ndarray, bits: int) -> float:
    """Over both images and their cells, given for each match (2, n), the sum of the root of its matches' `summed`."""
    total = 0.0
    for cell in cells:
        for occupied in set(cell.tolist()):
            members = [i for i in range(len(gains)) if cell[i] == occupied]
            total += rounded(math.sqrt(summed([gains[i] for i in members], [weights[i] for i in members], bits)), bits)
    return total


def lower_median(values: Sequence[float]) -> float:
    """The lower of the middle values."""
    return sorted(values)[(len(values) + 1) // 2 - 1]


def draws_for_confidence(inlier_ratio: float, size: int, confidence: float) -> float:
    """How many samples until one is all inliers with this probability."""
    return math.log1p(-confidence) / math.log1p(-(inlier_ratio**size))
