"""Confidence intervals of shares of pairs: sound from three pairs on, and where all of them or none succeed.

A percentile bootstrap has no width where every pair succeeds: of three right pairs it says [100, 100]. The score
interval does not, and is the usual recommendation for a proportion (Brown, Cai and DasGupta, "Interval Estimation for a
Binomial Proportion", Statistical Science 2001). Pairs of one scene succeed and fail together, so that n pairs tell as
much as fewer independent ones: the interval is that of the effective number of pairs (Korn and Graubard, "Confidence
intervals for proportions with small expected number of positive counts estimated from survey data", Survey Methodology
1998, with the score interval in place of Clopper and Pearson's).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from fmtorch.evaluation.bootstrap import LEVEL, MIN_SCENES, Interval, paired_bootstrap

MIN_UNITS = 10  # scenes, or pairs where those are resampled, below which a bootstrap of any other mean is not shown
Successes = NDArray[np.bool_] | NDArray[np.float64]
_Z = float(ndtri((1 + LEVEL) / 2))


def effective_pairs(values: NDArray[np.float64], scenes: Sequence[str]) -> float:
    """How many independent pairs tell as much of the mean as these, which come in scenes; at most n.

    n divided by the design effect: the variance of the mean with whole scenes as units over that with pairs as units,
    at least 1; and by the squared ratio of Student's quantiles, because few scenes tell their own spread badly. n with
    fewer than `MIN_SCENES` scenes, whose spread cannot be seen, and where all values are equal.

    Args:
        values: one per pair, (n,), n >= 1.
        scenes: the scene of each pair.
    """
    n = len(values)
    _, cluster = np.unique(np.asarray(scenes), return_inverse=True)
    m = int(cluster.max()) + 1
    centred = values - values.mean()
    alone = float((centred**2).sum()) * n / (n - 1) if n > 1 else 0.0
    if m < MIN_SCENES or alone <= n * np.finfo(np.float64).eps:
        return float(n)
    together = float((np.bincount(cluster, centred) ** 2).sum()) * m / (m - 1)
    quantiles = float(stdtrit(m - 1, (1 + LEVEL) / 2) / stdtrit(n - 1, (1 + LEVEL) / 2))
    return n / (max(1.0, together / alone) * quantiles**2)


def share_interval(successes: Successes, scenes: Sequence[str]) -> Interval:
    """The share of pairs that succeed, with Wilson's 95 % score interval for the effective number of pairs.

    Args:
        successes: (n,), n >= 1; of several seeds the share of those with which a pair succeeds, in [0, 1].
        scenes: the scene of each pair; `Interval.over` says whether scenes were many enough to be the units.
    """
    values = successes.astype(np.float64)
    p, n = float(values.mean()), effective_pairs(values, scenes)
    middle = (p + _Z**2 / (2 * n)) / (1 + _Z**2 / n)
    half = _Z / (1 + _Z**2 / n) * math.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
    # At the ends the bound is exact; rounding must not put it on the wrong side of the share.
    return Interval(p, min(max(0.0, middle - half), p), max(min(1.0, middle + half), p), _unit(scenes))


def share_difference(a: Successes, b: Successes, scenes: Sequence[str]) -> Interval:
    """Share of a minus share of b, of the same pairs, with the adjusted Wald interval of Bonett and Price.

    One pair more is counted on either side ("Adjusted Wald confidence interval for a difference of binomial proportions
    based on paired data", Journal of Educational and Behavioral Statistics 2012), so that methods which agree on every
    pair still have an interval of the width that so few pairs allow.

    Args:
        a, b: (n,), n >= 1, where either method succeeds; of several seeds as in `share_interval`.
        scenes: the scene of each pair.
    """
    difference = a.astype(np.float64) - b.astype(np.float64)
    n = effective_pairs(difference, scenes)
    only_a, only_b = (float((sign * difference).clip(min=0.0).mean()) for sign in (1, -1))
    p, q = (n * only_a + 1) / (n + 2), (n * only_b + 1) / (n + 2)
    half = _Z * math.sqrt((p + q - (p - q) ** 2) / (n + 2))
    value = float(difference.mean())
    low, high = max(-1.0, p - q - half), min(1.0, p - q + half)
    return Interval(value, min(low, value), max(high, value), _unit(scenes))


def mean_difference(a: NDArray[np.float64], b: NDArray[np.float64], scenes: Sequence[str]) -> Interval | None:
    """mean(a) - mean(b) of a figure that is no share, by `paired_bootstrap`; None of fewer than `MIN_UNITS` units."""
    units = len(set(scenes)) if _unit(scenes) == "scene" else len(a)
    return paired_bootstrap(a, b, scenes) if units >= MIN_UNITS else None


def _unit(scenes: Sequence[str]) -> str:
    return "scene" if len(set(scenes)) >= MIN_SCENES else "pair"
