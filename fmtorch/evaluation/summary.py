"""The figures of a run: recall with its interval, inlier rates, counts, failures, seconds; by family and over all."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.core.types import PAIR_TYPES
from fmtorch.evaluation.statistics import (
    MERITS,
    THRESHOLD,
    focal_figures,
    homography_figures,
    pose_figures,
    recalled,
    scene_names,
    share_interval,
)
from fmtorch.runs import PAIR_SCHEMA

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
    - recall: share of all pairs with NSGD < 0.05, a failed pair being a miss; recall_interval: its 95 % score
      interval, and interval_over: the unit that is independent (see `share_interval`). recall_fine: at NSGD < 0.01.
      auc_05: AUC@0.05, the mean of recall over the thresholds from 0 to 0.05. recall_released: by the published
      evaluator's NSGD, where that was computed for each pair that did not fail.
    - inlier_rate: share of the estimator's inliers that obey the true F, and inlier_rate_before: share of the matches
      given to it; means over the pairs that did not fail, as the paper; ``*_failures_0``: means over all pairs with 0
      for failures and where there is no figure.
    - corrs, corrs_before: number of inliers and of matches given to the estimator; means over pairs that did not fail.
    - failures, failure_share, reasons: the commonest reasons and how often; reasons that differ in numbers alone are
      one, with the range of these.
    - homography: of the pairs whose true homography is known, which have no NSGD and no recall, see
      `homography_figures`; None where there are none.
    - pose: of the pairs whose cameras are known, see `pose_figures`; None where there are none.
    - pair_types: how many pairs are in each of `PAIR_TYPES`; None where none is known.
    - focals: of the focal lengths that were estimated, see `focal_figures`; None where there are none.
    - seconds: median per pair for each stage, and ``total``.
    """
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
        group[name] = _mean(rate[ok])
        group[f"{name}_failures_0"] = _mean(np.where(ok, np.nan_to_num(rate), 0.0))
    for name in ("corrs", "corrs_before"):
        group[name] = _mean(_column(table, name)[ok])

    group["pose"] = pose_figures(_column(table, "rotation_error"), _column(table, "translation_error"), signed)
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
    group["seconds"] = {stage: _median(row) for stage, row in zip(STAGES, seconds, strict=True)}
    unknown = np.isnan(seconds).all(0)
    group["seconds"]["total"] = _median(np.where(unknown, np.nan, np.nansum(seconds, axis=0)))
    return group


def _column(table: pa.Table, name: str) -> NDArray[np.float64]:
    """A column as float64, null as NaN."""
    values: NDArray[np.float64] = table[name].cast(pa.float64()).to_numpy().astype(np.float64)
    return values


def _mean(values: NDArray[np.float64]) -> float | None:
    """The mean of what is not NaN."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None


def _median(values: NDArray[np.float64]) -> float | None:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else None


def common_reasons(reasons: Sequence[str], count: int) -> dict[str, int]:
    """At most `count` reasons with the number of their pairs, the commonest first.

    Reasons whose words are equal but for those with digits are one, which shows the range of numbers and what names
    have in common: "5 to 7 matches; at least 8 are needed", "no image scene/0000….png".
    """
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
    tail = _shared_start([word[len(head) :][::-1] for word in different])[::-1]
    return f"{head}…{tail}"


def _shared_start(words: Sequence[str]) -> str:
    columns = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*words, strict=False))
    return "".join(letters[0] for letters in columns)
