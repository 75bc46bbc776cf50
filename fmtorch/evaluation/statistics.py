"""Confidence intervals by resampling whole scenes, because the pairs of one scene are not independent."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from fmtorch import metrics
from fmtorch.metrics.recall import FINE_THRESHOLD as FINE_THRESHOLD
from fmtorch.metrics.recall import THRESHOLD as THRESHOLD

RESAMPLES = 2000
LEVEL = 0.95
MIN_SCENES = 5  # with fewer scenes their spread cannot be seen, and pairs are resampled
_SEED = 0
_BLOCK = 1 << 22  # numbers drawn at once: bounds the memory to some 100 MB


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean with its percentile bootstrap interval. over: what was resampled, ``scene`` or ``pair``.

    As text it is ``value [low, high]``, each number in the given format: ``f"{interval:+.1f}"``.
    """

    value: float
    low: float
    high: float
    over: str

    def __format__(self, form: str) -> str:
        return f"{self.value:{form}} [{self.low:{form}}, {self.high:{form}}]"


def bootstrap_mean(values: NDArray[np.float64], scenes: Sequence[str]) -> Interval:
    """The mean over all pairs, with a 95 % percentile interval from 2,000 resamples of scenes (Efron 1979).

    values: one per pair, (n,), n >= 1. scenes: the scene of each pair. With fewer than `MIN_SCENES` scenes the pairs
    are resampled instead, which is too narrow where pairs of a scene succeed and fail together. The interval has no
    width where all values are equal. The same input always gives the same interval.
    """
    _, cluster = np.unique(np.asarray(scenes), return_inverse=True)
    over = "scene" if cluster.max() + 1 >= MIN_SCENES else "pair"
    if over == "pair":
        cluster = np.arange(len(values))
    sums, sizes = np.bincount(cluster, values), np.bincount(cluster)
    means = np.concatenate([sums[draw].sum(1) / sizes[draw].sum(1) for draw in _draws(len(sums))])
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(sums.sum() / len(values)), float(low), float(high), over)


def paired_bootstrap(a: NDArray[np.float64], b: NDArray[np.float64], scenes: Sequence[str]) -> Interval:
    """mean(a) - mean(b) of two methods on the same pairs, as `bootstrap_mean` of the differences.

    a, b: (n,), e.g. 1.0 where NSGD is below the threshold. The methods differ at this level where the interval does
    not hold 0.
    """
    if len(a) != len(b):
        raise ValueError(f"paired_bootstrap compares the same pairs, but a has {len(a)} and b has {len(b)}")
    return bootstrap_mean(a - b, scenes)


def _draws(count: int) -> Iterator[NDArray[np.int64]]:
    """`RESAMPLES` samples with replacement of `count` clusters, in blocks (r, count)."""
    rng = np.random.default_rng(_SEED)
    rows = max(1, min(RESAMPLES, _BLOCK // count))
    for start in range(0, RESAMPLES, rows):
        yield rng.integers(0, count, (min(rows, RESAMPLES - start), count))


# Confidence intervals of shares of pairs: sound from three pairs on, and where all of them or none succeed


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


# Recall, AUC@0.05, their differences and intervals: what every table of this project takes its figures from


POSE_THRESHOLDS = (5, 10, 20)  # degrees
FOCAL_THRESHOLDS = (5, 10)  # percent
PERCENT = 100.0
Values = NDArray[np.float64]


def recalled(nsgd: Values, threshold: float = THRESHOLD) -> Values:
    """What each pair adds to recall, (n,): 1 where its NSGD is below the threshold, else 0; the mean over seeds.

    nsgd: (n,), or (seeds, n); NaN is a miss.
    """
    return _per_pair(metrics.recall(torch.from_numpy(nsgd)[..., None], threshold))


def areas(nsgd: Values) -> Values:
    """What each pair adds to AUC@0.05, (n,): the share of thresholds from 0 to 0.05 above its NSGD; mean over seeds.

    nsgd: (n,), or (seeds, n); NaN is a miss.
    """
    return _per_pair(metrics.mean_recall(torch.from_numpy(nsgd)[..., None], THRESHOLD))


MERITS: dict[str, Callable[[Values], Values]] = {
    "recall_05": recalled,
    "recall_01": partial(recalled, threshold=FINE_THRESHOLD),
    "auc_05": areas,
}
"""The figures of merit, by the names that rows, summaries and JSON files have for them: NSGD -> values of pairs."""


SHARES = ("recall_05", "recall_01")
"""Those of them that are shares of pairs."""


def pose_figures(rotation: Values, translation: Values, signed: bool = False) -> dict[str, float | int] | None:
    """Accuracy of poses over the pairs whose true pose is known; None where there is none.

    rotation, translation: angles in degrees of each pair, (n,); NaN where the true pose is unknown.

    - pairs: how many are known.
    - auc_5, auc_10, auc_20: `fmtorch.metrics.pose_auc` of the larger of the two angles; map_5, map_10, map_20: its
      binned mAP, `pose_map`; maa_10: `pose_maa`.
    - rotation, translation: median angles. signed: whether the sign of a translation counts, as it was told.
    """
    known = ~(np.isnan(rotation) | np.isnan(translation))
    if not known.any():
        return None
    errors = torch.from_numpy(np.maximum(rotation, translation)[known])
    areas, means = (f(errors, POSE_THRESHOLDS).tolist() for f in (metrics.pose_auc, metrics.pose_map))
    return {
        "pairs": int(known.sum()),
        **{f"auc_{t}": value for t, value in zip(POSE_THRESHOLDS, areas, strict=True)},
        "maa_10": float(metrics.pose_maa(errors)),
        **{f"map_{t}": value for t, value in zip(POSE_THRESHOLDS, means, strict=True)},
        "rotation": float(np.median(rotation[known])), "translation": float(np.median(translation[known])),
        "signed": signed,
    }  # fmt: skip


def focal_figures(errors: Values, log_ratios: Values, ok: NDArray[np.bool_]) -> dict[str, float | int | None] | None:
    """Accuracy of estimated focal lengths, of pairs (n, 2) by image; None where none was estimated.

    errors: relative, infinite where a focal length is not determined; NaN where none was to be estimated. log_ratios:
    log(f / f_true), NaN where there is none. ok: (n,), the others are misses.

    - images: how many focal lengths were to be estimated, those of failed pairs with them.
    - error: their median relative error, None where that is infinite; ratio: median f / f_true of those determined.
    - within_5, within_10: shares with a relative error of at most 5 and 10 %.
    """
    asked = ~np.isnan(errors)
    if not asked.any():
        return None
    failed = np.broadcast_to(~ok[:, None], errors.shape)
    values = np.where(failed, np.inf, errors)[asked | failed]
    median, ratios = float(np.median(values)), log_ratios[~np.isnan(log_ratios)]
    return {
        "images": len(values),
        "error": median if np.isfinite(median) else None,
        "ratio": float(np.exp(np.median(ratios))) if len(ratios) else None,
        **{f"within_{p}": float((values <= p / PERCENT).mean()) for p in FOCAL_THRESHOLDS},
    }


def interval(values: Values, scenes: Sequence[str], scale: float = 1.0, share: bool = False) -> Interval | None:
    """Mean of the values that are not NaN, times `scale`, with its 95 % interval; None where all are NaN.

    values, scenes: one per pair, (n,). share: the values are successes, see `share_interval`.
    """
    known = ~np.isnan(values)
    if not known.any():
        return None
    of = share_interval if share else bootstrap_mean
    return _scaled(of(values[known], _known_scenes(scenes, known)), scale)


def difference(a: Values, b: Values, scenes: Sequence[str], scale: float = 1.0, share: bool = False) -> Interval | None:
    """mean(a) - mean(b) of two methods on the same pairs, times `scale`, with its 95 % interval.

    Of the pairs for which both are not NaN; None where there are none, or too few for the figure (`mean_difference`).
    a, b, scenes: one per pair, (n,). share: the values are successes, see `share_difference`.
    """
    known = ~(np.isnan(a) | np.isnan(b))
    if not known.any():
        return None
    of = share_difference if share else mean_difference
    unscaled = of(a[known], b[known], _known_scenes(scenes, known))
    return None if unscaled is None else _scaled(unscaled, scale)


def scene_names(families: Sequence[str], scenes: Sequence[str]) -> list[str]:
    """The scene of each pair, with its family: two data sets may use one name for different scenes."""
    return [f"{family}/{scene}" for family, scene in zip(families, scenes, strict=True)]


def described(scenes: Sequence[str]) -> str:
    """``79 pairs of 2 scenes, intervals over pairs``: how many there are, and what intervals resample."""
    count = len(set(scenes))
    pairs = f"{len(scenes)} pair{'s' * (len(scenes) != 1)}"
    return f"{pairs} of {count} scene{'s' * (count != 1)}, intervals over {unit(scenes)}s"


def unit(scenes: Sequence[str]) -> str:
    """What the intervals of these pairs take as independent: ``scene``, or ``pair`` where scenes are too few."""
    return "scene" if len(set(scenes)) >= MIN_SCENES else "pair"


def _per_pair(values: torch.Tensor) -> Values:
    array: Values = values.double().numpy()
    return array.mean(0) if array.ndim > 1 else array


def _scaled(i: Interval, scale: float) -> Interval:
    return Interval(scale * i.value, scale * i.low, scale * i.high, i.over)


def _known_scenes(scenes: Sequence[str], known: NDArray[np.bool_]) -> list[str]:
    return [scene for scene, is_known in zip(scenes, known, strict=True) if is_known]
