"""The figures of `scripts/benchmark paper` as tables, beside the paper's: matches, estimators, what it claims."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmtorch.evaluation.statistics import PERCENT, Interval, described, difference, interval, recalled
from fmtorch.presets.pruners import WIDE
from scripts.benchmark.pipelines_table import REAL, Values, failed, nsgd_by_seed, solved_means
from scripts.benchmark.pruning_table import KIN, Row, scenes_of
from scripts.benchmark.sheet import MISSING, Published, Sheet, published, shown

VLFEAT = " vlfeat"  # follows the name of a method whose matches are of VLFeat's SIFT
PAPER = Path(__file__).resolve().parent / "paper_estimators.csv"  # Bian et al., BMVC 2019, tables of robust estimators
METHODS = {
    "paper/sift_ratio": "RANSAC", "paper/sift_ratio estimator=paper/lmeds": "LMedS",
    "paper/sift_ratio estimator=paper/msac": "MSAC", "paper/sift_ratio estimator=paper/usac": "USAC",
    "paper/sift_ratio estimator=paper/gc_ransac": "GC-RANSAC",
    "paper/sift_ratio estimator=paper/cf_ransac": "CF-RANSAC",
}  # fmt: skip
"""Pipelines by the paper's names for their estimators, in its order."""
CLAIMS = (
    *(("LMedS", other) for other in ("RANSAC", "MSAC", "USAC", "GC-RANSAC")),
    ("USAC", "RANSAC"), ("GC-RANSAC", "RANSAC"),
    *(("CF-RANSAC", other) for other in ("RANSAC", "LMedS", "MSAC", "USAC", "GC-RANSAC")),
)  # fmt: skip
"""Pairs of estimators whose difference in %Recall the paper's claims rest on."""


def tables(rows: list[Row]) -> list[Sheet]:
    """The matches of each family, a table for each, and differences; real pairs first, then rendered ones."""
    newest = sorted({(row["method"], row["pair"]): row for row in rows}.values(), key=lambda row: row["pair"])
    families = sorted({row["family"] for row in newest}, key=lambda f: (f not in REAL, f not in WIDE, f))
    paper = published(PAPER)
    return [
        _matches(newest, families, paper),
        *(_family(family, newest, paper) for family in families),
        *(_claims(families_of, title, newest, paper) for title, families_of in _parts(families).items()),
    ]


def _parts(families: Sequence[str]) -> dict[str, list[str]]:
    """The families of real and of rendered pairs, apart."""
    parts = {
        "Differences of %Recall, real pairs": [f for f in families if f in REAL],
        "Differences of %Recall, rendered pairs": [f for f in families if f not in REAL],
    }
    return {title: members for title, members in parts.items() if members}


def _own(rows: Sequence[Row], family: str, method: str) -> list[Row]:
    return [row for row in rows if row["family"] == family and row["method"] == method]


def _matches(rows: list[Row], families: Sequence[str], paper: Published) -> Sheet:
    """Keypoints, #Corrs-m and %Inlier-m of VLFeat's and of OpenCV's SIFT, beside the paper's."""
    lines = []
    for family in families:
        for name, label in (("VLFeat", VLFEAT), ("OpenCV", "")):
            own = _own(rows, family, next(iter(METHODS)) + label)
            if own:
                scenes = scenes_of(own)
                counts, rates = (_first(own, field) for field in ("corrs_before", "inlier_rate_before"))
                keypoints = np.mean([[row["features0"], row["features1"]] for row in own])
                line = paper.get((KIN.get(family, ""), next(iter(METHODS))), {})
                lines.append([
                    f"{family}, {name}", str(len(own)), f"{keypoints:.0f}",
                    shown(interval(counts, scenes), ".0f"), line.get("corrs_m", MISSING),
                    shown(interval(rates, scenes, PERCENT), ".1f"), line.get("inlier_m", MISSING),
                    KIN.get(family, MISSING),
                ])  # fmt: skip
    columns = ["", "pairs", "keypoints", "#Corrs-m", "paper", "%Inlier-m", "paper", "the paper's set"]
    return Sheet("Matches before estimation", columns, lines)


def _first(rows: Sequence[Row], field: str) -> Values:
    """A figure that is the same for all seeds, (n,); NaN where there were no matches."""
    return np.array([row[field][0] for row in rows], np.float64)


def _family(family: str, rows: Sequence[Row], paper: Published) -> Sheet:
    """Each estimator on VLFeat's matches, beside the paper's figures for the set of the same kind."""
    kin = KIN.get(family, "")
    lines = []
    for method, name in METHODS.items():
        own = _own(rows, family, method + VLFEAT)
        if own:
            line = paper.get((kin, method), {})
            lines.append([name, *_figures(own, line), failed(own)])
    title = f"{family}: {described(scenes_of(_own(rows, family, next(iter(METHODS)) + VLFEAT)))}"
    columns = ["", "%Recall", kin, "%Inlier", kin, "#Corrs", kin, "kept, %", kin, "failed"]
    return Sheet(title, columns, lines)


def _figures(rows: list[Row], line: dict[str, str]) -> list[str]:
    """%Recall, %Inlier, #Corrs and the share of matches that is kept, each followed by the paper's."""
    scenes = scenes_of(rows)
    recall = interval(recalled(nsgd_by_seed(rows)), scenes, PERCENT, share=True)
    inlier = interval(solved_means(rows, "inlier_rate"), scenes, PERCENT)
    corrs = solved_means(rows, "corrs")
    kept = interval(corrs / _first(rows, "corrs_before"), scenes, PERCENT)
    theirs = {key: line.get(key) or MISSING for key in ("recall", "inlier", "corrs")}
    share = f"{PERCENT * float(line['corrs']) / float(line['corrs_m']):.0f}" if line.get("corrs") else MISSING
    return [
        shown(recall, ".1f"), theirs["recall"], shown(inlier, ".1f"), theirs["inlier"],
        shown(interval(corrs, scenes), ".0f"), theirs["corrs"], shown(kept, ".0f"), share,
    ]  # fmt: skip


def _claims(families: Sequence[str], title: str, rows: Sequence[Row], paper: Published) -> Sheet:
    """What one estimator has more %Recall than another on the same pairs, beside the paper's difference."""
    presets = {name: method for method, name in METHODS.items()}
    lines = []
    for first, second in CLAIMS:
        cells = [f"{first} - {second}"]
        for family in families:
            a, b = (
                {row["pair"]: row for row in _own(rows, family, presets[name] + VLFEAT)} for name in (first, second)
            )
            common = [pair for pair in a if pair in b]
            gain = _difference([a[pair] for pair in common], [b[pair] for pair in common]) if common else None
            cells += [shown(gain, "+.1f"), _published(paper, KIN.get(family, ""), presets[first], presets[second])]
        lines.append(cells)
    columns = [column for family in families for column in (family, KIN.get(family, ""))]
    return Sheet(title, ["", *columns], lines)


def _difference(a: list[Row], b: list[Row]) -> Interval | None:
    return difference(recalled(nsgd_by_seed(a)), recalled(nsgd_by_seed(b)), scenes_of(a), PERCENT, share=True)


def _published(paper: Published, dataset: str, first: str, second: str) -> str:
    """The paper's difference in %Recall."""
    a, b = paper.get((dataset, first)), paper.get((dataset, second))
    return f"{float(a['recall']) - float(b['recall']):+.1f}" if a and b else MISSING
