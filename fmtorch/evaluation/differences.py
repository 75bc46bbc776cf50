"""Paired differences of the figures of two runs, as a table of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.evaluation.curves import NSGD, axis_of
from fmtorch.evaluation.rows import THRESHOLDS as CORNER_THRESHOLDS
from fmtorch.evaluation.statistics import (
    FINE_THRESHOLD,
    LEVEL,
    MIN_UNITS,
    PERCENT,
    THRESHOLD,
    Interval,
    areas,
    mean_difference,
    scene_names,
    share_difference,
)
from fmtorch.evaluation.tables import DASH, Bar, Cell, Table, common, shared_keys


def differences(runs: Mapping[str, pa.Table]) -> Table | None:
    """The first run minus each other one, on the pairs that the two share; None of a single run."""
    if len(runs) < 2:
        return None
    axis = axis_of(runs)
    first, *others = runs
    key, family, place = (runs[first][name].to_pylist() for name in ("key", "family", "scene"))
    scene = dict(zip(key, scene_names(family, place), strict=True))
    by_run = {}
    for other in others:
        two = {first: runs[first], other: runs[other]}
        a, b = common(two, axis.column)
        ahead = _ahead if axis is NSGD else _ahead_in_corners
        by_run[other] = (len(a), ahead(a, b, [scene[key] for key in shared_keys(two)]))
    ends = [abs(end) for _, cells in by_run.values() for _, i in cells if i for end in (i.low, i.high)]
    widest = max(ends, default=1.0) or 1.0
    rows = {
        name: [Cell(f"{count:,}"), *(Cell(text, bar=_around_zero(i, widest)) for text, i in cells)]
        for name, (count, cells) in by_run.items()
    }
    figures = [f"recall at {THRESHOLD}", f"at {FINE_THRESHOLD}", "AUC@0.05"]
    head = ["run", "shared pairs", *(figures if axis is NSGD else [f"AUC@{t} px" for t in CORNER_THRESHOLDS])]
    note = (
        f"In points; positive where {first} is ahead of the row's run. In brackets the paired {LEVEL:.0%} interval "
        f"(Bonett and Price's for recall, a bootstrap for AUC@0.05 from {MIN_UNITS} scenes or pairs on): a difference "
        "whose interval holds 0 may be chance."
    )
    return Table(f"{first} minus each other run, pair by pair", head, rows, note)


def _ahead(a: NDArray[np.float64], b: NDArray[np.float64], scenes: Sequence[str]) -> list[tuple[str, Interval | None]]:
    """Differences of recall at both thresholds and of AUC@0.05, with intervals, of NSGD of the same pairs."""
    if not len(a):
        return [(DASH, None)] * 3
    intervals = [share_difference(a < t, b < t, scenes) for t in (THRESHOLD, FINE_THRESHOLD)]
    parts = areas(a), areas(b)
    area = mean_difference(*parts, scenes)
    texts = [(_signed(i), i) for i in intervals]
    difference = f"{PERCENT * float((parts[0] - parts[1]).mean()):+.1f} (n too small)"
    return [*texts, (difference, None) if area is None else (_signed(area), area)]


def _ahead_in_corners(
    a: NDArray[np.float64], b: NDArray[np.float64], scenes: Sequence[str]
) -> list[tuple[str, Interval | None]]:
    """Differences of the share of thresholds up to each one above a pair's corner error, with intervals."""
    cells: list[tuple[str, Interval | None]] = []
    for threshold in CORNER_THRESHOLDS:
        own, other = (np.clip(1 - np.nan_to_num(errors, nan=np.inf) / threshold, 0, 1) for errors in (a, b))
        area = mean_difference(own, other, scenes) if len(a) else None
        difference = f"{PERCENT * float((own - other).mean()):+.1f} (n too small)" if len(a) else DASH
        cells.append((difference, None) if area is None else (_signed(area), area))
    return cells


def _signed(i: Interval) -> str:
    return f"{100 * i.value:+.1f} [{100 * i.low:+.1f}, {100 * i.high:+.1f}]"


def _around_zero(i: Interval | None, widest: float) -> Bar | None:
    if i is None:
        return None
    low, value, high = (50 + 50 * end / widest for end in (i.low, i.value, i.high))
    return Bar(low, value, high, zero=50.0)
