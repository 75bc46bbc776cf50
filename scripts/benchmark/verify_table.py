"""Tables of verified databases and of what mappers made of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from scripts.benchmark.kept import Row
from scripts.benchmark.sheet import MISSING, Sheet
from scripts.benchmark.verify_mappers import MAPPERS, THRESHOLDS

FEATURES = {"colmap": "COLMAP's SIFT", "ours": "our features"}
Figure = tuple[str, Callable[[Row], float], int]  # column, value of a row, digits


def _field(name: str) -> Callable[[Row], float]:
    return lambda row: float(row.get(name, np.nan))


VERIFICATION: tuple[Figure, ...] = (
    ("pairs", lambda row: row["pairs"], 0),
    ("with a geometry", lambda row: row["verified"], 0),
    ("ms a pair", lambda row: 1000 * row["seconds"] / row["pairs"], 1),
    ("pairs a second", lambda row: row["pairs"] / row["seconds"], 0),
    ("poses", lambda row: row["poses"], 0),
    ("right", lambda row: row["right"], 0),
    ("wrong", lambda row: row["wrong"], 0),
)
MODEL: tuple[Figure, ...] = (
    ("registered", lambda row: row["registered"], 1),
    ("points", _field("points"), 0),
    ("track", _field("track"), 2),
    ("error, px", _field("error"), 2),
    *((f"AUC@{limit}", _field(f"auc{limit}"), 1) for limit in THRESHOLDS),
    *((f"centres@{limit}", _field(f"centre{limit}"), 1) for limit in THRESHOLDS),
    ("s", lambda row: row["seconds"], 1),
)


def method_name(method: str) -> str:
    kind, _, threshold = method.partition(":")
    default = " (default)" if threshold == "4" else ""
    return "`fmtorch verify`" if kind == "ours" else f"COLMAP, {threshold} px{default}"


def sheets(rows: Sequence[Row], methods: Sequence[str]) -> list[Sheet]:
    """The tables of all rows: a summary, then for each kind of features and cameras verification and both mappers."""
    kinds = list(dict.fromkeys((row["features"], row["cameras"]) for row in rows))
    tables = []
    for features, cameras in kinds:
        of_kind = [row for row in rows if (row["features"], row["cameras"]) == (features, cameras)]
        title = f"{FEATURES[features]}, {cameras} intrinsics"
        verified = [row for row in of_kind if not row["mapper"]]
        tables.append(_sheet(f"{title}: pairs", verified, methods, VERIFICATION))
        for mapper in MAPPERS:
            models = [row for row in of_kind if row["mapper"] == mapper]
            if models:
                tables.append(_sheet(f"{title}: {mapper} mapper", models, methods, MODEL))
    return [_summary(rows, methods, kinds), *tables]


def _sheet(title: str, rows: Sequence[Row], methods: Sequence[str], figures: Iterable[Figure]) -> Sheet:
    """A line for each scene and method: means of the seeds."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for method in methods:
            mine = [row for row in rows if (row["scene"], row["method"]) == (scene, method)]
            if mine:
                cells = [_mean((value(row) for row in mine), digits) for _, value, digits in figures]
                lines.append([scene, method_name(method), str(len(mine)), *cells])
    return Sheet(title, ["scene", "verified by", "seeds", *(name for name, _, _ in figures)], lines)


def _mean(values: Iterable[float], digits: int) -> str:
    known = [value for value in values if not np.isnan(value)]
    return f"{np.mean(known):,.{digits}f}" if known else MISSING


def _summary(rows: Sequence[Row], methods: Sequence[str], kinds: Sequence[tuple[str, str]]) -> Sheet:
    """Means over the scenes: pairs a second, and of each mapper registered images and AUC of relative poses."""
    lines = []
    for features, cameras in kinds:
        of_kind = [row for row in rows if (row["features"], row["cameras"]) == (features, cameras)]
        for method in methods:
            mine = [row for row in of_kind if row["method"] == method]
            of_each: list[Row] = [row for row in mine if not row["mapper"]]
            pairs, seconds = (sum(_by_scene(of_each, _field(name))) for name in ("pairs", "seconds"))
            cells = [str(len({row["scene"] for row in mine})), f"{pairs / seconds:,.0f}" if seconds else MISSING]
            for mapper in MAPPERS:
                models = [row for row in mine if row["mapper"] == mapper]
                cells += [
                    _mean(_by_scene(models, lambda row: 100 * row["registered"] / row["images"]), 1),
                    *(_mean(_by_scene(models, _field(f"auc{n}")), 1) for n in THRESHOLDS),
                ]
            if mine:
                lines.append([FEATURES[features], cameras, method_name(method), *cells])
    columns = [f"{mapper}: {name}" for mapper in MAPPERS for name in ("registered, %", *(f"@{n}" for n in THRESHOLDS))]
    title = "Means of the scenes: AUC of relative poses at 1, 5 and 10 degrees"
    return Sheet(title, ["features", "intrinsics", "verified by", "scenes", "pairs a second", *columns], lines)


def _by_scene(rows: Sequence[Row], value: Callable[[Row], float]) -> list[float]:
    """The mean of the seeds of each scene."""
    scenes = dict.fromkeys(row["scene"] for row in rows)
    return [float(np.mean([value(row) for row in rows if row["scene"] == scene])) for scene in scenes]
