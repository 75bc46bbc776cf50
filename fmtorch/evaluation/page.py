"""The report of several runs: tables, paired differences, curves and pictures on one HTML page."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from typing import Any

import cv2
import numpy as np
import pyarrow as pa

from fmtorch.evaluation import curves, tables
from fmtorch.evaluation.canvas import Image
from fmtorch.evaluation.statistics import THRESHOLD
from fmtorch.evaluation.summary import summarize

QUALITY, WIDTH = 80, 1280  # of JPEG pictures; px
DISAGREEMENT = 0.1  # NSGD beyond which a result is as bad as any


@dataclasses.dataclass(frozen=True)
class Picture:
    """An RGB picture and what it shows."""

    image: Image
    alt: str
    caption: str

    def encoded(self) -> tuple[str, int, int]:
        """A JPEG as a URL of its data, and its width and height, which keep its place until it is shown."""
        image = self.image
        if image.shape[1] > WIDTH:
            height = round(image.shape[0] * WIDTH / image.shape[1])
            image = np.asarray(cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
        jpeg = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
        height, width = image.shape[:2]
        return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}", width, height


@dataclasses.dataclass(frozen=True)
class Shown:
    """A pair as one run sees it. nsgd: None where it failed, with the reason. configuration: empty where unknown.

    corner_error: px, in place of NSGD where the pair has a homography.
    """

    run: str
    nsgd: float | None
    reason: str = ""
    pictures: Sequence[Picture] = ()
    configuration: str = ""
    corner_error: float | None = None

    @property
    def good(self) -> bool:
        """Whether its error is below the threshold that is marked in the curves."""
        if self.corner_error is not None:
            return self.corner_error < curves.CORNERS.mark
        return self.nsgd is not None and self.nsgd < THRESHOLD

    @property
    def result(self) -> str:
        """What is said of it."""
        if self.corner_error is not None:
            return f"failed: {self.reason}" if self.reason else f"corner error {self.corner_error:.2f} px"
        result = f"failed: {self.reason}" if self.nsgd is None else f"NSGD {self.nsgd:.4f}"
        return f"{result}, {self.configuration}" if self.configuration not in ("", "general") else result


@dataclasses.dataclass(frozen=True)
class ShownPair:
    """A pair of images as each run sees it; notes: what the reader should know of the pictures."""

    name: str
    runs: Sequence[Shown]
    notes: Sequence[str] = ()


@dataclasses.dataclass(frozen=True)
class Section:
    """The runs on one data set: tables of `PAIR_SCHEMA` by the runs' names, the first is what others differ from.

    notes: what the reader should know of the pictures of pairs, or why there are none. signed: the runs in which the
    sign of a translation counts.
    """

    heading: str
    runs: Mapping[str, pa.Table]
    pairs: Sequence[ShownPair] = ()
    notes: Sequence[str] = ()
    signed: Collection[str] = ()


def render(
    title: str,
    sections: Sequence[Section],
    runs: Sequence[Sequence[str]],
    shared: Sequence[tuple[str, str]] = (),
) -> str:
    """The page: one file that loads nothing, whose script sorts and filters and whose content does without it.

    runs: name, data set, identity, version, seed and folder of each run. shared: settings that all have in common.
    """
    try:
        import jinja2
    except ImportError as error:
        raise ImportError("a report needs jinja2: pip install 'fmtorch[report]'") from error
    names = list(dict.fromkeys([*(row[0] for row in runs), *(name for s in sections for name in s.runs)]))
    script = _resource("report.js")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_resource("report.html.j2")).render(
        title=title, runs=runs, shared=shared, names=names,
        swatches={name: curves.swatch(i) for i, name in enumerate(names)},
        sections=[_context(section, names) for section in sections],
        style=curves.style_sheet() + _resource("report.css"), script=script,
        policy="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-"
        + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() + "'",
    )  # fmt: skip


def differing_pairs(runs: Mapping[str, pa.Table], count: int) -> list[str]:
    """Identities of `count` pairs that all runs hold: those where NSGD differs most, of as many scenes as there are.

    Of a single run: from its best pair to its worst, in equal steps.
    """
    axis = curves.axis_of(runs)
    most = DISAGREEMENT if axis is curves.NSGD else axis.maximum
    nsgd = np.stack([np.minimum(v, most) for v in tables.common(runs, axis.column)])
    first = next(iter(runs.values()))
    at = {key: i for i, key in enumerate(first["key"].to_pylist())}
    rows = [at[key] for key in tables.shared_keys(runs)]
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


def _resource(name: str) -> str:
    return resources.files("fmtorch.evaluation").joinpath(name).read_text(encoding="utf-8")


def _context(section: Section, names: Sequence[str]) -> dict[str, Any]:
    summaries = {name: summarize(table, name in section.signed) for name, table in section.runs.items()}
    axis = curves.axis_of(section.runs)
    pairs = {table.num_rows for table in section.runs.values()}
    facts = f"{len(section.runs)} runs" if len(section.runs) > 1 else "One run"
    counts = f"{min(pairs):,}" + (f" to {max(pairs):,}" if len(pairs) > 1 else "")
    return {
        "heading": section.heading,
        "facts": f"{facts}, {counts} pair{'s' * (pairs != {1})}{' each' * (len(section.runs) > 1)}.",
        "legend": tables.caption(next(iter(summaries.values()))),
        "tables": tables.report_tables(section.runs, summaries),
        "names": list(section.runs),
        "axis": axis.label,
        "curves": [
            (title, curves.svg(title, panel, names, axis)) for title, panel in curves.panels(section.runs).items()
        ],
        "pairs": section.pairs,
        "notes": section.notes,
    }
