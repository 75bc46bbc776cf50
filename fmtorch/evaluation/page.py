"""The report of several runs: tables, paired differences, curves and pictures on one HTML page."""

from __future__ import annotations

import base64
import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.evaluation.pictures import Image
from fmtorch.evaluation.plots import plot_recall_curves
from fmtorch.evaluation.statistics import FINE_THRESHOLD, MERITS, PERCENT, THRESHOLD, difference, scene_names
from fmtorch.evaluation.summary import ALL, MARKDOWN_COLUMNS, STAGES, caption, summarize

QUALITY, WIDTH = 82, 1280  # of JPEG pictures; px
DISAGREEMENT = 0.1  # NSGD beyond which a result is as bad as any


@dataclasses.dataclass(frozen=True)
class Picture:
    """An RGB picture and what it shows."""

    image: Image
    alt: str
    caption: str


@dataclasses.dataclass(frozen=True)
class ShownPair:
    """A pair of images with pictures of it; notes: what the reader should know of them."""

    heading: str
    pictures: Sequence[Picture]
    notes: Sequence[str] = ()


@dataclasses.dataclass(frozen=True)
class Section:
    """The runs on one data set: tables of `PAIR_SCHEMA` by the runs' names, the first is what others differ from.

    no_pictures: why there are none, for the reader.
    """

    heading: str
    runs: Mapping[str, pa.Table]
    pairs: Sequence[ShownPair] = ()
    no_pictures: str = ""


def render(title: str, sections: Sequence[Section], runs: Sequence[Sequence[str]]) -> str:
    """The page. runs: name, identity, version, seed and folder of each run."""
    text = resources.files("fmtorch.evaluation").joinpath("report.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(text).render(title=title, sections=[_context(s) for s in sections], runs=runs)


def differing_pairs(runs: Mapping[str, pa.Table], count: int) -> list[str]:
    """Identities of `count` pairs that all runs hold: those where NSGD differs most, of as many scenes as there are.

    Of a single run: from its best pair to its worst, in equal steps.
    """
    nsgd = np.stack([np.minimum(v, DISAGREEMENT) for v in _common(runs, "nsgd")])
    first = next(iter(runs.values()))
    at = {key: i for i, key in enumerate(first["key"].to_pylist())}
    rows = [at[key] for key in _keys(runs)]
    if not rows or count < 1:
        return []
    names, scenes = first["pair"].to_pylist(), first["scene"].to_pylist()
    if len(runs) == 1:
        order = np.argsort(nsgd[0], kind="stable")
        chosen = order[np.unique(np.linspace(0, len(order) - 1, min(count, len(order))).round().astype(int))]
        return [names[rows[i]] for i in chosen]
    order = np.argsort(-np.ptp(nsgd, axis=0), kind="stable")
    seen: dict[str, int] = {}
    turns = []
    for i in order:  # the first of every scene, then the second of every scene
        turns.append(seen.setdefault(scenes[rows[i]], 0))
        seen[scenes[rows[i]]] += 1
    chosen = order[np.argsort(turns, kind="stable")][:count]
    return [names[rows[i]] for i in chosen]


def _keys(runs: Mapping[str, pa.Table]) -> list[int]:
    """The pairs that all runs hold, in the order of the first."""
    tables = list(runs.values())
    shared = set.intersection(*(set(table["key"].to_pylist()) for table in tables))
    return [key for key in tables[0]["key"].to_pylist() if key in shared]


def _common(runs: Mapping[str, pa.Table], column: str) -> list[NDArray[np.float64]]:
    """A column of each run, of the pairs that all hold."""
    keys = _keys(runs)
    found = []
    for table in runs.values():
        values = dict(zip(table["key"].to_pylist(), table[column].to_pylist(), strict=True))
        found.append(np.array([values[key] for key in keys], np.float64))
    return found


def _context(section: Section) -> dict[str, Any]:
    summaries = {name: summarize(table) for name, table in section.runs.items()}
    pairs = {name: table.num_rows for name, table in section.runs.items()}
    facts = f"{len(section.runs)} runs" if len(section.runs) > 1 else "one run"
    counts = f"{min(pairs.values()):,}" + (f" to {max(pairs.values()):,}" if len(set(pairs.values())) > 1 else "")
    return {
        "heading": section.heading,
        "facts": f"{facts}, {counts} pairs each. {caption(next(iter(summaries.values())))}",
        "tables": [table for table in (_merit(summaries), _families(summaries), _differences(section.runs)) if table]
        + [_seconds(summaries)],
        "curves": _curves(section.runs),
        "pictures": [
            {
                "heading": pair.heading,
                "notes": pair.notes,
                "pictures": [{"source": _jpeg(p.image), "alt": p.alt, "caption": p.caption} for p in pair.pictures],
            }
            for pair in section.pairs
        ],
        "no_pictures": section.no_pictures,
    }


def _merit(summaries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """All figures over all pairs, a row a run."""
    columns = {heading: column for heading, column in MARKDOWN_COLUMNS.items() if heading}
    rows = [[name, *(column(summary[ALL]) for column in columns.values())] for name, summary in summaries.items()]
    ranked = {"%Recall [interval]": "recall", f"at {FINE_THRESHOLD}": "recall_fine", "AUC@0.05": "auc_05"}
    best = {
        heading: _best([summary[ALL][field] for summary in summaries.values()]) for heading, field in ranked.items()
    }
    return _table("Figures of merit", ["run", *columns], rows, {1 + list(columns).index(h): b for h, b in best.items()})


def _families(summaries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """Recall and AUC@0.05 by family; None where there is but one."""
    names = dict.fromkeys(family for summary in summaries.values() for family in summary if family != ALL)
    if len(names) < 2:
        return None
    rows, best = [], {}
    for name, summary in summaries.items():
        groups = [summary.get(family) for family in names]
        rows.append(
            [name, *("–" if g is None else f"{100 * g['recall']:.1f} / {100 * g['auc_05']:.1f}" for g in groups)]
        )
    for i, family in enumerate(names, start=1):
        best[i] = _best([summary[family]["auc_05"] if family in summary else None for summary in summaries.values()])
    return _table(f"By family: %Recall at {THRESHOLD} / AUC@0.05", ["run", *names], rows, best)


def _differences(runs: Mapping[str, pa.Table]) -> dict[str, Any] | None:
    """What the first run is ahead of the others by, on the pairs they share; None of a single run."""
    if len(runs) < 2:
        return None
    first, *others = runs
    key, family, place = (runs[first][name].to_pylist() for name in ("key", "family", "scene"))
    scene = dict(zip(key, scene_names(family, place), strict=True))
    rows = []
    for other in others:
        two = {first: runs[first], other: runs[other]}
        a, b = _common(two, "nsgd")
        rows.append([other, f"{len(a):,}", *_ahead(a, b, [scene[key] for key in _keys(two)])])
    head = ["run", "shared pairs", f"recall at {THRESHOLD}", f"at {FINE_THRESHOLD}", "AUC@0.05"]
    note = "In points, with the paired 95 % bootstrap interval: a difference whose interval holds 0 may be chance."
    return {**_table(f"What {first} is ahead by", head, rows, {}), "note": note}


def _ahead(a: NDArray[np.float64], b: NDArray[np.float64], scenes: Sequence[str]) -> list[str]:
    """Differences of recall at both thresholds and of AUC@0.05, of NSGD of the same pairs."""
    found = [difference(values(a), values(b), scenes, scale=PERCENT) for values in MERITS.values()]
    return ["–" if interval is None else f"{interval:+.1f}" for interval in found]


def _seconds(summaries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    stages = [*STAGES, "total"]
    rows = [
        [name, *("–" if (s := summary[ALL]["seconds"][stage]) is None else f"{s:.3f}" for stage in stages)]
        for name, summary in summaries.items()
    ]
    failed = [
        f"{name}: {count} × {reason}"
        for name, summary in summaries.items()
        for reason, count in summary[ALL]["reasons"].items()
    ]
    note = ("Pairs that failed: " + "; ".join(failed)) if failed else ""
    return {**_table("Seconds a pair, median", ["run", *stages], rows, {}), "note": note}


def _table(
    heading: str, head: Sequence[str], rows: Sequence[Sequence[str]], best: Mapping[int, set[int]]
) -> dict[str, Any]:
    """best: the rows to stress of some columns."""
    cells = [
        [{"text": text, "best": i in best.get(j, set())} for j, text in enumerate(row)] for i, row in enumerate(rows)
    ]
    return {"heading": heading, "head": list(head), "rows": cells, "note": ""}


def _best(values: Sequence[float | None]) -> set[int]:
    """Where the largest is; nowhere of a single value."""
    known = [value for value in values if value is not None]
    return {i for i, value in enumerate(values) if value == max(known)} if len(known) > 1 else set()


def _curves(runs: Mapping[str, pa.Table]) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recall.svg"
        plot_recall_curves(runs, path)
        return _data("image/svg+xml", path.read_bytes())


def _jpeg(image: Image) -> str:
    if image.shape[1] > WIDTH:
        height = round(image.shape[0] * WIDTH / image.shape[1])
        image = np.asarray(cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
    encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    return _data("image/jpeg", encoded.tobytes())


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
