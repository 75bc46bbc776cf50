"""Recall, AUC@0.05, their differences and intervals: what every table of this project takes its figures from.

A figure is the mean over pairs of what each pair adds to it. Pairs of one scene succeed and fail together: the units
of intervals are scenes, and pairs only where there are fewer than five scenes, which every table then says
(`described`). Means have the bootstrap's percentile intervals. Where every pair succeeds these have no width: of three
right pairs they say [100, 100]. Shares of pairs, such as recall, therefore have the score interval, the usual
recommendation for a proportion (Brown, Cai and DasGupta, "Interval Estimation for a Binomial Proportion", Statistical
Science 2001), of the effective number of pairs (Korn and Graubard, "Confidence intervals for proportions with small
expected number of positive counts estimated from survey data", Survey Methodology 1998)."""

import dataclasses
import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from fmtorch import metrics
from fmtorch.core.files import counted
from fmtorch.core.types import PAIR_TYPES
from fmtorch.metrics.recall import FINE_THRESHOLD as FINE_THRESHOLD
from fmtorch.metrics.recall import THRESHOLD as THRESHOLD
from fmtorch.runs import PAIR_SCHEMA

POSE_THRESHOLDS = (5, 10, 20)  # degrees
FOCAL_THRESHOLDS = (5, 10)  # percent
CORNER_THRESHOLDS = (1, 3, 5)  # px, as LightGlue (Lindenberger et al., ICCV 2023); SuperGlue and LoFTR: 3, 5, 10
PERCENT = 100.0
LEVEL = 0.95
RESAMPLES = 2000
MIN_SCENES = 5  # with fewer scenes their spread cannot be seen, and pairs are the units
MIN_UNITS = 10  # below which a bootstrap of a difference is not shown
_SEED = 0
_BLOCK = 1 << 22  # numbers drawn at once: bounds the memory to some 100 MB
_Z = float(ndtri((1 + LEVEL) / 2))
Values = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean with its percentile bootstrap interval. over: what was resampled, ``scene`` or ``pair``.
    As text it is ``value [low, high]``, each number in the given format: ``f"{interval:+.1f}"``."""

    value: float
    low: float
    high: float
    over: str

    def scaled(self, scale: float) -> "Interval":
        return Interval(scale * self.value, scale * self.low, scale * self.high, self.over)

    def __format__(self, form: str) -> str:
        return f"{self.value:{form}} [{self.low:{form}}, {self.high:{form}}]"


def recalled(nsgd: Values, threshold: float = THRESHOLD) -> Values:
    """What each pair adds to recall, (n,): 1 where its NSGD is below the threshold, else 0; the mean over seeds.
    nsgd: (n,), or (seeds, n); NaN is a miss."""
    return _per_pair(metrics.recall(torch.from_numpy(nsgd)[..., None], threshold))


def areas(errors: Values, threshold: float = THRESHOLD) -> Values:
    """What each pair adds to AUC@0.05, (n,): the share of thresholds from 0 to 0.05 above its NSGD; see `recalled`."""
    return _per_pair(metrics.mean_recall(torch.from_numpy(errors)[..., None], threshold))


_FINE = partial(recalled, threshold=FINE_THRESHOLD)
MERITS: dict[str, Callable[[Values], Values]] = {"recall_05": recalled, "recall_01": _FINE, "auc_05": areas}
"""The figures of merit, by the names that rows, summaries and JSON files have for them: NSGD -> values of pairs."""


def _per_pair(values: torch.Tensor) -> Values:
    array: Values = values.double().numpy()
    return array.mean(0) if array.ndim > 1 else array


def pose_figures(rotation: Values, translation: Values, signed: bool = False) -> dict[str, float | int] | None:
    """Accuracy of poses over the pairs whose true pose is known; None where there is none.
    rotation, translation: angles in degrees of each pair, (n,); NaN where the true pose is unknown. signed: whether the
    sign of a translation counts, as it was told. auc_5, auc_10, auc_20: `fmtorch.metrics.pose_auc` of the larger of the
    two angles; map_5, map_10, map_20: its binned mAP, `pose_map`; maa_10: `pose_maa`; the others: medians."""
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


def label_figures(precision: Values, recall: Values) -> dict[str, float] | None:
    """Means over pairs, (n,), of the precision, recall and F-score of matches; None where all are NaN."""
    known = ~(np.isnan(precision) | np.isnan(recall))
    if not known.any():
        return None
    p, r = precision[known], recall[known]
    f = 2 * p * r / np.maximum(p + r, np.finfo(np.float64).tiny)
    return {"precision": float(p.mean()), "recall": float(r.mean()), "f_score": float(f.mean())}


def focal_figures(errors: Values, log_ratios: Values, ok: NDArray[np.bool_]) -> dict[str, float | int | None] | None:
    """Accuracy of estimated focal lengths, of pairs (n, 2) by image; None where none was estimated.
    errors: relative, infinite where a focal length is not determined; NaN where none was to be estimated. log_ratios:
    log(f / f_true), NaN where there is none. ok: (n,), the others are misses. images: how many focal lengths were to be
    estimated, those of failed pairs with them; error: their median relative error, None where that is infinite; ratio:
    median f / f_true of those determined; within_5, within_10: shares with a relative error of at most 5 and 10 %."""
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


def homography_figures(errors: Values) -> dict[str, float | int | None] | None:
    """Accuracy of homographies over the pairs whose true one is known; None where there is none.
    errors: corner errors in pixels, (n,), infinite where a pair failed, NaN where no homography is known. auc_1px,
    auc_3px, auc_5px: `fmtorch.metrics.pose_auc` of them; corner_error: the median, None where that is infinite."""
    known = errors[~np.isnan(errors)]
    if not len(known):
        return None
    areas = metrics.pose_auc(torch.from_numpy(known), CORNER_THRESHOLDS).tolist()
    median = float(np.median(known))
    return {
        "pairs": len(known), **{f"auc_{t}px": area for t, area in zip(CORNER_THRESHOLDS, areas, strict=True)},
        "corner_error": median if math.isfinite(median) else None,
    }  # fmt: skip


def interval(values: Values, scenes: Sequence[str], scale: float = 1.0, share: bool = False) -> Interval | None:
    """Mean of the values that are not NaN, times `scale`, with its 95 % interval; None where all are NaN.
    values, scenes: one per pair, (n,). share: the values are successes, see `share_interval`."""
    known, places = _without_nan(scenes, values)
    if not len(places):
        return None
    return (share_interval if share else bootstrap_mean)(values[known], places).scaled(scale)


def difference(a: Values, b: Values, scenes: Sequence[str], scale: float = 1.0, share: bool = False) -> Interval | None:
    """mean(a) - mean(b) of two methods on the same pairs, times `scale`, with its 95 % interval.
    Of the pairs for which both are not NaN; None where there are none, or, for a figure that is no share, fewer than
    `MIN_UNITS` units. The methods differ at this level where the interval does not hold 0.
    a, b, scenes: one per pair, (n,). share: the values are successes, see `share_difference`."""
    if len(a) != len(b):
        raise ValueError(f"a difference is of the same pairs, but a has {len(a)} and b has {len(b)}")
    known, places = _without_nan(scenes, a, b)
    if not len(places):
        return None
    if share:
        return share_difference(a[known], b[known], places).scaled(scale)
    units = len(set(places)) if unit(places) == "scene" else len(places)
    return bootstrap_mean((a - b)[known], places).scaled(scale) if units >= MIN_UNITS else None


def _without_nan(scenes: Sequence[str], *values: Values) -> tuple[NDArray[np.bool_], list[str]]:
    known: NDArray[np.bool_] = ~np.any([np.isnan(each) for each in values], axis=0)
    return known, [scene for scene, is_known in zip(scenes, known, strict=True) if is_known]


def scene_names(families: Sequence[str], scenes: Sequence[str]) -> list[str]:
    """The scene of each pair, with its family: two data sets may use one name for different scenes."""
    return [f"{family}/{scene}" for family, scene in zip(families, scenes, strict=True)]


def described(scenes: Sequence[str]) -> str:
    """``79 pairs of 2 scenes, intervals over pairs``: how many there are, and what intervals resample."""
    pairs, distinct = counted(len(scenes), "pair"), counted(len(set(scenes)), "scene")
    return f"{pairs} of {distinct}, intervals over {unit(scenes)}s"


def unit(scenes: Sequence[str]) -> str:
    """What the intervals of these pairs take as independent: ``scene``, or ``pair`` where scenes are too few."""
    return "scene" if len(set(scenes)) >= MIN_SCENES else "pair"


def _clusters(scenes: Sequence[str]) -> NDArray[np.int64]:
    if unit(scenes) == "pair":
        return np.arange(len(scenes))
    return np.unique(np.asarray(scenes), return_inverse=True)[1]


def bootstrap_mean(values: Values, scenes: Sequence[str]) -> Interval:
    """The mean over all pairs, with a 95 % percentile interval from 2,000 resamples of scenes (Efron 1979).
    With fewer than `MIN_SCENES` scenes the pairs are resampled instead, which is too narrow where pairs of a scene
    succeed and fail together. The interval has no width where all values are equal. The same input always gives the
    same interval. values, scenes: one per pair, (n,), n >= 1."""
    cluster = _clusters(scenes)
    sums, sizes = np.bincount(cluster, values), np.bincount(cluster)
    means = np.concatenate([sums[draw].sum(1) / sizes[draw].sum(1) for draw in _draws(len(sums))])
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(sums.sum() / len(values)), float(low), float(high), unit(scenes))


def _draws(count: int) -> Iterator[NDArray[np.int64]]:
    """`RESAMPLES` samples with replacement of `count` clusters, in blocks (r, count)."""
    rng = np.random.default_rng(_SEED)
    rows = max(1, min(RESAMPLES, _BLOCK // count))
    for start in range(0, RESAMPLES, rows):
        yield rng.integers(0, count, (min(rows, RESAMPLES - start), count))


def effective_pairs(values: NDArray[np.float64], scenes: Sequence[str]) -> float:
    """How many independent pairs tell as much of the mean as these, which come in scenes; at most n.
    n divided by the design effect: the variance of the mean with whole scenes as units over that with pairs as units,
    at least 1; and by the squared ratio of Student's quantiles, because few scenes tell their own spread badly. n with
    fewer than `MIN_SCENES` scenes, and where all values are equal. values, scenes: per pair, (n,), n >= 1."""
    n, m = len(values), len(set(scenes))
    centred = values - values.mean()
    alone = float((centred**2).sum()) * n / (n - 1) if n > 1 else 0.0
    if m < MIN_SCENES or alone <= n * np.finfo(np.float64).eps:
        return float(n)
    together = float((np.bincount(_clusters(scenes), centred) ** 2).sum()) * m / (m - 1)
    quantiles = float(stdtrit(m - 1, (1 + LEVEL) / 2) / stdtrit(n - 1, (1 + LEVEL) / 2))
    return n / (max(1.0, together / alone) * quantiles**2)


def share_interval(successes: Values | NDArray[np.bool_], scenes: Sequence[str]) -> Interval:
    """The share of pairs that succeed, with Wilson's 95 % score interval for the effective number of pairs.
    successes: (n,), n >= 1; of several seeds the share of those with which a pair succeeds, in [0, 1]. scenes: one per
    pair; `Interval.over` says whether these were many enough to be the units."""
    values = successes.astype(np.float64)
    p, n = float(values.mean()), effective_pairs(values, scenes)
    middle = (p + _Z**2 / (2 * n)) / (1 + _Z**2 / n)
    half = _Z / (1 + _Z**2 / n) * math.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
    # At the ends the bound is exact; rounding must not put it on the wrong side of the share.
    return Interval(p, min(max(0.0, middle - half), p), max(min(1.0, middle + half), p), unit(scenes))


def share_difference(a: Values | NDArray[np.bool_], b: Values | NDArray[np.bool_], scenes: Sequence[str]) -> Interval:
    """Share of a minus share of b, of the same pairs, with the adjusted Wald interval of Bonett and Price.
    One pair more is counted on either side ("Adjusted Wald confidence interval for a difference of binomial proportions
    based on paired data", Journal of Educational and Behavioral Statistics 2012), so that methods which agree on every
    pair still have an interval of the width that so few pairs allow.
    a, b: (n,), n >= 1, where either method succeeds; of several seeds as in `share_interval`. scenes: one per pair."""
    difference = a.astype(np.float64) - b.astype(np.float64)
    n = effective_pairs(difference, scenes)
    only_a, only_b = (float((sign * difference).clip(min=0.0).mean()) for sign in (1, -1))
    p, q = (n * only_a + 1) / (n + 2), (n * only_b + 1) / (n + 2)
    half = _Z * math.sqrt((p + q - (p - q) ** 2) / (n + 2))
    value = float(difference.mean())
    low, high = max(-1.0, p - q - half), min(1.0, p - q + half)
    return Interval(value, min(low, value), max(high, value), unit(scenes))


ALL = "all"
STAGES = tuple(name.removeprefix("seconds_") for name in PAIR_SCHEMA.names if name.startswith("seconds_"))
_REASONS = 3  # commonest reasons kept
_NUMBER = re.compile(r"(\d+(?:\.\d+)?)([;,:.]?)")

Group = dict[str, Any]


def summarize(table: pa.Table, signed: bool = False) -> dict[str, Group]:
    """Figures of merit of a table of `PAIR_SCHEMA`: for each family, and for ``all`` pairs.

    signed: whether the sign of a translation counts in its rows, of `pose_errors`.

    All shares are in [0, 1]; a figure that is not defined is None. Of each group:

    - pairs, scenes: how many.
    - recall: share of all pairs with NSGD < 0.05, a failed pair being a miss; recall_interval: its 95 % score interval,
      and interval_over: the unit that is independent (see `share_interval`). recall_fine: at NSGD < 0.01. auc_05:
      AUC@0.05, mean recall over thresholds from 0 to 0.05. recall_released: by `nsgd_released`, where computed.
    - inlier_rate: share of the estimator's inliers that obey the true F, and inlier_rate_before: share of the matches
      given to it; means over pairs that did not fail, as the paper; ``*_failures_0``: over all, 0 where there is none.
    - corrs, corrs_before: number of inliers and of matches given to the estimator; means over pairs that did not fail.
    - failures, failure_share, reasons: the commonest reasons and how often, see `common_reasons`.
    - homography: of pairs with a true homography, which have no NSGD, see `homography_figures`; None without any.
    - pose: of the pairs whose cameras are known, see `pose_figures`; None where there are none.
    - labels: of given matches of pairs with known cameras, see `label_figures`; None where there are none.
    - pair_types: how many pairs are in each of `PAIR_TYPES`; None where none is known.
    - focals: of the focal lengths that were estimated, see `focal_figures`; None where there are none.
    - seconds: median per pair for each stage, and ``total``."""
    families = table["family"].to_pylist()
    groups = {name: table.filter(pa.array([f == name for f in families])) for name in dict.fromkeys(families)}
    return {name: _group(part, signed) for name, part in {**groups, ALL: table}.items()}


def _group(table: pa.Table, signed: bool) -> Group:
    ok = table["ok"].to_numpy().astype(bool)
    nsgd = _column(table, "nsgd")
    scenes = scene_names(table["family"].to_pylist(), table["scene"].to_pylist())
    group: Group = {"pairs": len(ok), "scenes": len(set(scenes))}

    group |= {"recall": None, "recall_interval": None, "interval_over": None, "recall_fine": None, "auc_05": None}
    if len(ok) and not np.isnan(nsgd).all():
        interval = share_interval(nsgd < THRESHOLD, scenes)
        group |= {
            "recall": interval.value, "recall_interval": [interval.low, interval.high], "interval_over": interval.over,
            "recall_fine": float(MERITS["recall_01"](nsgd).mean()), "auc_05": float(MERITS["auc_05"](nsgd).mean()),
        }  # fmt: skip
    released = np.where(ok, _column(table, "nsgd_released"), 1.0)
    known = group["recall"] is not None and not np.isnan(released).any()
    group["recall_released"] = float(recalled(released).mean()) if known else None

    for name in ("inlier_rate", "inlier_rate_before"):
        rate = _column(table, name)
        group[name] = _of_known(np.mean, rate[ok])
        group[f"{name}_failures_0"] = _of_known(np.mean, np.where(ok, np.nan_to_num(rate), 0.0))
    for name in ("corrs", "corrs_before"):
        group[name] = _of_known(np.mean, _column(table, name)[ok])

    group["pose"] = pose_figures(_column(table, "rotation_error"), _column(table, "translation_error"), signed)
    group["labels"] = label_figures(_column(table, "match_precision"), _column(table, "match_recall"))
    group["homography"] = homography_figures(_column(table, "corner_error"))
    kinds = Counter(kind for kind in table["pair_type"].to_pylist() if kind is not None)
    group["pair_types"] = {name: kinds[name] for name in PAIR_TYPES} if kinds else None
    columns = ("focal_error0", "focal_error1"), ("focal_log_ratio0", "focal_log_ratio1")
    errors, ratios = (np.stack([_column(table, name) for name in names], 1) for names in columns)
    group["focals"] = focal_figures(errors, ratios, ok)
    failures = int((~ok).sum())
    group |= {
        "failures": failures, "failure_share": failures / len(ok) if len(ok) else None,
        "reasons": common_reasons([reason for reason in table["reason"].to_pylist() if reason], _REASONS),
    }  # fmt: skip
    seconds = np.stack([_column(table, f"seconds_{stage}") for stage in STAGES])
    total = np.where(np.isnan(seconds).all(0), np.nan, np.nansum(seconds, axis=0))
    named = zip((*STAGES, "total"), (*seconds, total), strict=True)
    group["seconds"] = {stage: _of_known(np.median, values) for stage, values in named}
    return group


def _column(table: pa.Table, name: str) -> NDArray[np.float64]:
    values: NDArray[np.float64] = table[name].cast(pa.float64()).to_numpy().astype(np.float64)
    return values


def _of_known(figure: Callable[[Values], Any], values: Values) -> float | None:
    known = values[~np.isnan(values)]
    return float(figure(known)) if len(known) else None


def common_reasons(reasons: Sequence[str], count: int) -> dict[str, int]:
    """At most `count` reasons with the number of their pairs, the commonest first.
    Reasons whose words are equal but for those with digits are one, which shows the range of numbers and what names
    have in common: "5 to 7 matches; at least 8 are needed", "no image scene/0000….png"."""
    kinds: dict[tuple[str, ...], list[list[str]]] = {}
    for reason in reasons:
        words = reason.split()
        kinds.setdefault(tuple("" if re.search(r"\d", word) else word for word in words), []).append(words)
    common = Counter({kind: len(alike) for kind, alike in kinds.items()}).most_common(count)
    return {" ".join(_merged(column) for column in zip(*kinds[kind], strict=True)): n for kind, n in common}


def _merged(words: Sequence[str]) -> str:
    """One word for those at the same place of several reasons."""
    different = sorted(set(words))
    if len(different) == 1:
        return different[0]
    numbers = [match for word in different if (match := _NUMBER.fullmatch(word))]
    if len(numbers) == len(different) and len({match[2] for match in numbers}) == 1:
        ordered = sorted((match[1] for match in numbers), key=float)
        return f"{ordered[0]} to {ordered[-1]}{numbers[0][2]}"
    head = _shared_start(different)
    return f"{head}…{_shared_start([word[len(head) :][::-1] for word in different])[::-1]}"


def _shared_start(words: Sequence[str]) -> str:
    columns = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*words, strict=False))
    return "".join(letters[0] for letters in columns)
