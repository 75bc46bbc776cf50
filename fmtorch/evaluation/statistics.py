"""Recall, AUC@0.05, their differences and intervals: what every table of this project takes its figures from.

A figure is the mean over pairs of what each pair adds to it. Shares of pairs, such as recall, have score intervals, all
other means the bootstrap's (see `intervals`). Pairs of one scene succeed and fail together: the units are scenes, and
pairs only where there are fewer than five scenes, which every table then says (`described`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch import metrics
from fmtorch.evaluation.bootstrap import MIN_SCENES, Interval, bootstrap_mean
from fmtorch.evaluation.intervals import mean_difference, share_difference, share_interval
from fmtorch.metrics.recall import FINE_THRESHOLD as FINE_THRESHOLD
from fmtorch.metrics.recall import THRESHOLD as THRESHOLD

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
