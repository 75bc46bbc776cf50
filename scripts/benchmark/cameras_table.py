"""Figures and tables of `scripts/benchmark cameras`, from its rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.data import ImagePair
from fmtorch.evaluation.statistics import PERCENT, POSE_THRESHOLDS, areas, described, difference, recalled
from fmtorch.metrics.recall import FINE_THRESHOLD
from scripts.benchmark.cameras_knowledge import LEVELS
from scripts.benchmark.cameras_methods import OURS, read
from scripts.benchmark.estimators_table import replaced
from scripts.benchmark.kept import Row
from scripts.benchmark.matched import groups, scenes
from scripts.benchmark.sheet import MISSING, Sheet

Figures = dict[str, dict[str, dict[str, Any]]]  # method -> group -> figure
Values = NDArray[np.float64]
FOCAL_ERRORS = (0.05, 0.1)  # relative
BASELINES = ("wide baselines", "short baselines")


def figures(rows: dict[str, list[Row]], pairs: Sequence[ImagePair]) -> Figures:
    """The figures of each method over each group of pairs that it has rows of, in percent and milliseconds.

    ahead_*: what our own method of the level, or else the first of it, has more, with its 95 % interval. ms_ratio: the
    median over pairs of the time relative to that method's.
    """
    values: Figures = {}
    first: dict[str, str] = {}
    for method in sorted(rows, key=lambda method: read(method).name != OURS):
        first.setdefault(read(method).level, method)
    by_method = {method: _by_pair(own) for method, own in rows.items()}
    for method, by_pair in by_method.items():
        reference = by_method[first[read(method).level]]
        values[method] = {}
        for group, inside in groups(list(pairs)).items():
            group_pairs = [
                pair for pair, member in zip(pairs, inside, strict=True) if member and pair.identity in by_pair
            ]
            if group_pairs:
                values[method][group] = _figures(by_pair, reference, group_pairs)
    return values


def _by_pair(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each pair, one a seed."""
    by_pair: dict[str, list[Row]] = {}
    for row in rows:
        by_pair.setdefault(row["pair"], []).append(row)
    return by_pair


def _figures(own: dict[str, list[Row]], first: dict[str, list[Row]], pairs: Sequence[ImagePair]) -> dict[str, Any]:
    """One method's figures over some pairs."""
    names, where = [pair.identity for pair in pairs], scenes(list(pairs))
    figures: dict[str, Any] = {"pairs": len(names)}
    merits, reference = (_merits(rows, names) for rows in (own, first))
    for name, values in merits.items():
        figures[name] = PERCENT * float(values.mean())
        ahead = None if own is first else difference(reference[name], values, where, PERCENT)
        figures[f"ahead_{name}"] = None if ahead is None else [ahead.value, ahead.low, ahead.high]
    posed = [row["flipped"] for name in names for row in own[name] if row["posed"]]
    figures["flipped"] = PERCENT * float(np.mean(posed)) if posed else None
    errors = np.array([error for name in names for row in own[name] for error in row.get("focals", ())])
    for bound in FOCAL_ERRORS:
        share = PERCENT * float((errors <= bound).mean()) if len(errors) else None
        figures[f"focal_{round(PERCENT * bound)}"] = share
    ms, of_first = (_matrix(rows, names, "ms") for rows in (own, first))
    figures |= {"ms_median": float(np.median(ms)), "ms_ratio": float(np.median(ms.mean(0) / of_first.mean(0)))}
    return figures


def _merits(rows: dict[str, list[Row]], names: Sequence[str]) -> dict[str, Values]:
    """What each pair adds to the figures of merit, (pairs,), mean over seeds."""
    nsgd = _matrix(rows, names, "nsgd")
    of_f = {"recall_01": recalled(nsgd, FINE_THRESHOLD), "auc_05": areas(nsgd)}
    return {**{f"pose_{t}": _accuracy(rows, names, t) for t in POSE_THRESHOLDS}, **of_f}


def _matrix(rows: dict[str, list[Row]], names: Sequence[str], field: str) -> Values:
    """A field of the rows, (seeds, pairs)."""
    return np.array([[row[field] for row in rows[name]] for name in names], np.float64).T


def _accuracy(rows: dict[str, list[Row]], names: Sequence[str], threshold: float) -> Values:
    """What each pair adds to the area under the step curve of pose errors up to a threshold in degrees, (pairs,)."""
    worst = np.maximum(*(_matrix(rows, names, field) for field in ("rotation", "translation")))
    share: Values = np.clip(1 - worst / threshold, 0, 1).mean(0)
    return share


def sheets(figures: Figures, pairs: Sequence[ImagePair], seeds: int) -> list[Sheet]:
    """A table for each level of knowledge, then pose and focal lengths of each set of pairs."""
    all_groups = groups(list(pairs))
    shown = [group for group in BASELINES if group in all_groups] or [list(all_groups)[-1]]
    used = {read(method).level for method in figures}
    levels = [_level(figures, level, shown) for level in LEVELS if level in used]
    families = [group for group in all_groups if group not in (*BASELINES, "all")]
    focals = [method for method, own in figures.items() if any(f["focal_5"] is not None for f in own.values())]
    return [
        *levels,
        _of_families(f"Pose AUC@5° of each set, {seeds} seeds", figures, list(figures), families, _pose_5),
        _of_families("Focal lengths within 5 % / 10 %, % of images", figures, focals, families, _focals),
    ]


def _level(figures: Figures, level: str, shown: Sequence[str]) -> Sheet:
    """One level's methods on wide and on short baselines."""
    columns = ["method"]
    for group in shown:
        columns += [f"{group}: pose 5/10/20°", "lead, 5°", "R.01 / AUC@0.05", "flipped"]
    rows = []
    for method, own in figures.items():
        if read(method).level == level:
            cells = [cell for group in shown for cell in _cells(own.get(group))]
            rows.append([f"`{_label(method)}`", *cells, *_times(own)])
    return Sheet(f"{level}: {LEVELS[level]}", [*columns, "ms", "time"], rows)


def _label(method: str) -> str:
    """A method without its level."""
    name, _, rest = method.partition(":")
    return ":".join(filter(None, (name, rest.partition(":")[2])))


def _cells(own: dict[str, Any] | None) -> list[str]:
    if own is None:
        return [MISSING] * 4
    ahead = own["ahead_pose_5"]
    return [
        " / ".join(f"{own[f'pose_{t}']:.1f}" for t in POSE_THRESHOLDS),
        "" if ahead is None else "{:+.1f} [{:+.1f}, {:+.1f}]".format(*ahead),
        f"{own['recall_01']:.1f} / {own['auc_05']:.1f}",
        MISSING if own["flipped"] is None else f"{own['flipped']:.1f}",
    ]


def _times(own: dict[str, dict[str, Any]]) -> list[str]:
    """Milliseconds over all pairs, and relative to the method that leads are of."""
    last = own[list(own)[-1]]
    return [f"{last['ms_median']:.1f}", f"{last['ms_ratio']:.2f}"]


def _of_families(title: str, figures: Figures, methods: Sequence[str], families: Sequence[str], cell: Any) -> Sheet:
    rows = []
    for method in methods:
        own = figures[method]
        rows.append([f"`{method}`", *(cell(own[family]) if family in own else MISSING for family in families)])
    return Sheet(title, ["method", *families], rows)


def _pose_5(own: dict[str, Any]) -> str:
    return f"{own['pose_5']:.1f}"


def _focals(own: dict[str, Any]) -> str:
    if own["focal_5"] is None:
        return MISSING
    return f"{own['focal_5']:.0f} / {own['focal_10']:.0f}"


def write(path: Path, marker: str, figures: Figures, pairs: Sequence[ImagePair], seeds: int) -> None:
    """The tables between the markers of a Markdown file. Raises SystemExit where it has none."""
    inside = groups(list(pairs))
    names = [group for group in (*BASELINES, "all") if group in inside]
    places = "; ".join(
        f"{group}: {described([s for s, member in zip(scenes(list(pairs)), inside[group], strict=True) if member])}"
        for group in names
    )
    note = (
        "Pose: area under the recall curve of the larger of the angles of rotation and folded translation to 5/10/20°, "
        "in %; R.01 / AUC@0.05: of F, by NSGD; flipped: translations that point backwards, in %. Lead: our own method "
        f"minus this in AUC@5°, with its 95 % interval. Mean of {seeds} seeds. {places}. ms: median of processor time "
        "a pair over all, one thread; time: median ratio to our own, pair by pair."
    )
    text = "\n\n".join([note, *(sheet.markdown() for sheet in sheets(figures, pairs, seeds))])
    if not replaced(path, marker, text):
        raise SystemExit(f"{path} has no lines <!-- {marker} --> and <!-- end {marker} -->")
