"""The figures of `scripts/benchmark learned` as tables."""

from __future__ import annotations

import numpy as np

from fmtorch.evaluation.statistics import MERITS, PERCENT, described, difference, interval
from scripts.benchmark.pruning_table import Row, nsgd_of, scenes_of
from scripts.benchmark.sheet import MISSING, Sheet, shown

areas = MERITS["auc_05"]
WIDE = {"Strecha": "real", "PhotoTourism": "real", "orbit": "rendered", "collection": "rendered"}
SHORT = {"KITTI": "real", "TUM": "real", "indoor": "rendered", "driving": "rendered"}
BASELINE = {"hard": "ratio", "prior": "frame consistency"}
ESTIMATOR = {"ransac_eight_point": "RANSAC", "lmeds_eight_point": "LMedS", "fmtorch": "fmtorch"}


def tables(rows: list[Row]) -> list[Sheet]:
    """Real and rendered sets apart: wide and short baselines, then each family; one table for each use.

    Last, other trainings of a network beside the one that is shipped.
    """
    trainings, rows = rows, [row for row in rows if not row.get("training_of")]
    sheets = []
    for features in dict.fromkeys(row["features"] for row in rows):
        mine = [row for row in rows if row["features"] == features]
        for title, families in _groups([row["family"] for row in mine]).items():
            for use in ("hard", "prior"):
                own = [row for row in mine if row["family"] in families and row["use"] == use]
                sheets += [_sheet(title, features, use, own)] if own else []
    for shipped in dict.fromkeys(row["training_of"] for row in trainings if row.get("training_of")):
        own = [row for row in trainings if row.get("training_of") == shipped or row["method"] == shipped]
        seen = dict.fromkeys(row["features"] for row in own if row["method"] == shipped)
        others = {row["features"] for row in own if row.get("training_of")}
        sheets += [
            _trainings(shipped, use, [row for row in own if (row["features"], row["use"]) == (features, use)])
            for features in seen if features in others for use in ("hard", "prior")
        ]  # fmt: skip
    return sheets


def _trainings(shipped: str, use: str, rows: list[Row]) -> Sheet:
    """A line for each training, the shipped one first; pairs that all of them have, by kind of baseline."""
    estimator = rows[0]["estimator"]
    rows = [row for row in rows if row["estimator"] == estimator]
    methods = [shipped, *dict.fromkeys(row["method"] for row in rows if row["method"] != shipped)]
    by_method = {name: {row["pair"]: row for row in rows if row["method"] == name} for name in methods}
    common = set.intersection(*(set(own) for own in by_method.values()))
    columns, lines = [""], [[name] for name in methods]
    for kind in ("real", "rendered"):
        for baselines, members in (("wide", WIDE), ("short", SHORT)):
            base = [row for row in by_method[shipped].values()
                    if row["pair"] in common and members.get(row["family"]) == kind]  # fmt: skip
            if not base:
                continue
            columns += [f"{kind}, {baselines} ({len(base)}): R.05", "AUC@0.05", f"AUC - {shipped}"]
            for name, line in zip(methods, lines, strict=True):
                own = [by_method[name][row["pair"]] for row in base]
                nsgd = nsgd_of(own)
                line += [f"{100 * MERITS['recall_05'](nsgd).mean():.1f}", f"{100 * areas(nsgd).mean():.1f}"]
                line.append("" if name == shipped else _difference(own, {row["pair"]: row for row in base}))
    how = f"P < 0.5 dropped, {ESTIMATOR[estimator]}" if use == "hard" else "P(inlier) as the prior of `fmtorch`"
    return Sheet(f"Trainings of {shipped}: {how}; {rows[0]['features']}, pairs in brackets", columns, lines)


def _groups(present: list[str]) -> dict[str, list[str]]:
    families = list(dict.fromkeys(present))
    groups: dict[str, list[str]] = {}
    for kind in ("real", "rendered"):
        for name, members in (("wide", WIDE), ("short", SHORT)):
            same_kind = [f for f in families if members.get(f) == kind]
            if len(same_kind) > 1:
                groups[f"{kind.capitalize()}, {name} baselines ({', '.join(same_kind)})"] = same_kind
    return groups | {family: [family] for family in families}


def _sheet(title: str, features: str, use: str, rows: list[Row]) -> Sheet:
    estimators = list(dict.fromkeys(row["estimator"] for row in rows))
    columns = [""]
    for estimator in estimators:
        name = ESTIMATOR[estimator]
        columns += [f"{name}: R.05", "R.01", "AUC@0.05", f"AUC - {BASELINE[use]}"]
    columns += ["%Inlier-m", "#Corrs-m", "ms"] if use == "hard" else ["ms"]
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        line = [method]
        for estimator in estimators:
            estimator_rows = [row for row in own if row["estimator"] == estimator]
            base = {row["pair"]: row for row in rows
                    if row["method"] == BASELINE[use] and row["estimator"] == estimator}  # fmt: skip
            nsgd = nsgd_of(estimator_rows)
            line += [f"{100 * MERITS[name](nsgd).mean():.1f}" for name in ("recall_05", "recall_01")]
            line.append(shown(interval(areas(nsgd), scenes_of(estimator_rows), PERCENT), ".1f"))
            line.append(_difference(estimator_rows, base) if method != BASELINE[use] else "")
        once = [row for row in own if row["estimator"] == estimators[0]]
        if use == "hard":
            rate = [row["inlier_rate_before"] for row in once if not np.isnan(row["inlier_rate_before"])]
            line += [
                f"{100 * np.mean(rate):.1f}" if rate else MISSING,
                f"{np.mean([row['corrs_before'] for row in once]):.0f}",
            ]
        line.append(f"{np.median([row['ms'] for row in once]):.1f}")
        lines.append(line)
    what = "matches dropped before the paper's estimators" if use == "hard" else "P(inlier) as the prior of `fmtorch`"
    return Sheet(
        f"{title}: {what}; {features}, {described(scenes_of({row['pair']: row for row in rows}.values()))}",
        columns,
        lines,
    )


def _difference(rows: list[Row], base: dict[str, Row]) -> str:
    if not rows or any(row["pair"] not in base for row in rows):
        return ""
    other = [base[row["pair"]] for row in rows]
    return shown(difference(areas(nsgd_of(rows)), areas(nsgd_of(other)), scenes_of(rows), PERCENT), "+.1f")
