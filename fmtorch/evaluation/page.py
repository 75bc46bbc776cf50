"""The report of several runs: tables, paired differences, curves and pictures on one HTML page."""

import base64
import hashlib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import pyarrow as pa

from fmtorch import presets
from fmtorch.core import lazy, settings
from fmtorch.evaluation import curves, statistics, tables
from fmtorch.pipeline.photographs import Image
from fmtorch.pipeline.pictures import jpeg_url

QUALITY, WIDTH = 80, 1280  # of JPEG pictures; px
DISAGREEMENT = 0.1  # NSGD beyond which a result is as bad as any


class Picture(NamedTuple):
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
        return jpeg_url(image, QUALITY), image.shape[1], image.shape[0]


class Shown(NamedTuple):
    """A pair as one run sees it. nsgd: None where it failed, with the reason. pair_type: empty where unknown.
    corner_error: px, in place of NSGD where the pair has a homography."""

    run: str
    nsgd: float | None
    reason: str = ""
    pictures: Sequence[Picture] = ()
    pair_type: str = ""
    corner_error: float | None = None

    @property
    def good(self) -> bool:
        if self.corner_error is not None:
            return self.corner_error < curves.CORNERS.mark
        return self.nsgd is not None and self.nsgd < statistics.THRESHOLD

    @property
    def result(self) -> str:
        if self.corner_error is not None:
            return f"failed: {self.reason}" if self.reason else f"corner error {self.corner_error:.2f} px"
        result = f"failed: {self.reason}" if self.nsgd is None else f"NSGD {self.nsgd:.4f}"
        return f"{result}, {self.pair_type}" if self.pair_type not in ("", "general") else result


class ShownPair(NamedTuple):
    """A pair of images as each run sees it; notes: what the reader should know of the pictures."""

    name: str
    runs: Sequence[Shown]
    notes: Sequence[str] = ()


class Section(NamedTuple):
    """The runs on one data set: tables of `PAIR_SCHEMA` by the runs' names, the first is what others differ from.
    notes: what the reader should know of the pictures of pairs, or why there are none. signed: the runs in which the
    sign of a translation counts."""

    heading: str
    runs: Mapping[str, pa.Table]
    pairs: Sequence[ShownPair] = ()
    notes: Sequence[str] = ()
    signed: Collection[str] = ()


def render(
    title: str, sections: Sequence[Section], runs: Sequence[Sequence[str]], shared: Sequence[tuple[str, str]] = ()
) -> str:
    """The page: one file that loads nothing, whose script sorts and filters and whose content does without it.
    runs: name, data set, identity, version, seed and folder of each run. shared: settings that all have in common."""
    jinja2 = lazy.imported("jinja2", "a report needs jinja2: pip install 'fmtorch[report]'")
    names = list(dict.fromkeys([*(row[0] for row in runs), *(name for s in sections for name in s.runs)]))
    script = curves.resource("report.js")
    options: dict[str, Any] = {"undefined": jinja2.StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    page: str = jinja2.Environment(autoescape=True, **options).from_string(curves.resource("report.html.j2")).render(
        title=title, runs=runs, shared=shared, names=names,
        styles={name: curves.style(i) for i, name in enumerate(names)},
        sections=[_context(section, names) for section in sections],
        style=curves.resource("curves.css") + curves.resource("report.css"), script=script,
        policy="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-"
        + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() + "'",
    )  # fmt: skip
    return page


def differing_pairs(runs: Mapping[str, pa.Table], count: int) -> list[str]:
    """Identities of `count` pairs that all runs hold: those where NSGD differs most, of as many scenes as there are.
    Of a single run: from its best pair to its worst, in equal steps."""
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


def _context(section: Section, names: Sequence[str]) -> dict[str, Any]:
    summaries = {name: statistics.summarize(table, name in section.signed) for name, table in section.runs.items()}
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


MAX_OPTIONS = 3  # that a name tells of a stage; of more the identity's first digits do
_DIGITS = 6  # of an identity
_LONG = re.compile(r"([0-9a-f]{7})[0-9a-f]+")  # a commit or a digest, whose first digits do


def run_names(
    configs: Sequence[Mapping[str, Any]], identities: Sequence[str], groups: Sequence[str] | None = None
) -> list[str]:
    """A name for each run, no two alike within a group.
    The pipeline's name, unless all runs share it and differ in something else; of the runs of one pipeline the presets,
    options, seeds and versions in which they differ, other than those that the pipeline has of itself; and an
    identity's first digits where that does not tell them apart. configs: `RunFolder.config` of each. identities: what
    is unique. groups: what runs are shown together, such as the data set; all in one if not given."""
    groups = [""] * len(configs) if groups is None else groups
    pipelines = [str(config.get("pipeline", "run")) for config in configs]
    details = []
    for pipeline, config in zip(pipelines, configs, strict=True):
        same = [other for name, other in zip(pipelines, configs, strict=True) if name == pipeline]
        details.append(list(_details(config, same)))
    shared = len(set(pipelines)) == 1 and len(configs) > 1 and all(details)
    each = zip(pipelines, details, groups, strict=True)
    named = [(" ".join(words if shared else [pipeline, *words]), group) for pipeline, words, group in each]
    own = zip(named, identities, strict=True)
    return [entry[0] if named.count(entry) == 1 else f"{entry[0]} {digits[:_DIGITS]}" for entry, digits in own]


def shared_settings(configs: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """What all runs have in common, which their names leave out: the pipeline, stages' presets, seed and version."""
    common = []
    for group in ("pipeline", *presets.STAGES, "seed", "version"):
        values = [config.get(group) for config in configs]
        if values[0] in (None, {}, []) or any(value != values[0] for value in values):
            continue
        words = [*_pruners(values[0])] if group == "pruner" else [str(values[0])]
        if isinstance(values[0], Mapping):
            words = list(_stage(group, values[0], []))
        common.append((group, ", ".join(words)))
    return common


def _details(config: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What tells a run from the others of its pipeline, word by word."""
    usual = presets.pipeline_stages(str(config.get("pipeline"))) or {}
    for group in (*presets.STAGES, "seed", "version"):
        values = [run.get(group) for run in runs]
        mine = config.get(group)
        if group not in config or all(value == mine for value in values) or mine == usual.get(group):
            continue
        if group == "pruner":  # the names where their order or the choice differs, and options that differ
            own, others = _pruners(mine), [_pruners(value) for value in values]
            if any(list(other) != list(own) for other in others):
                yield "+".join(own) or "no pruner"
            yield from _words(dict(_options(own, others)))
        elif isinstance(mine, Mapping):
            yield from _stage(group, mine, [value for value in values if isinstance(value, Mapping)])
        elif group == "version":
            yield "version=" + _LONG.sub(r"\1", str(mine))
        else:
            yield f"{group}={mine}"


def _stage(group: str, mine: Mapping[str, Any], values: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The name of a stage's preset or class where others have another, and the options that others, or it, have not."""
    kind, changed = _kind(group, mine)
    alike = [value for value in values if _kind(group, value)[0] == kind]
    others = [dict(settings.leaves(dict(value))) for value in values]
    options = dict(_options(mine, alike)) or {
        key: text for key, text in changed.items() if not others or any(other.get(key) != text for other in others)
    }
    if len(alike) < len(values) or not options or not values:
        yield kind
    yield from _words(options)


def _kind(group: str, value: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """The preset from which a stage differs least, and the options in which it does; without one its class."""
    close = presets.closest(group, value)
    if close is None:
        return str(value.get("_target_", group)).rpartition(".")[2], {}
    return close[0], {key: text for key, text in settings.leaves(close[1]) if key}


def _words(options: Mapping[str, str]) -> list[str]:
    words = [f"{key}={text.strip(chr(34))}" for key, text in options.items()]
    return words if len(words) <= MAX_OPTIONS else []


def _pruners(value: Any) -> dict[str, Any]:
    """The pruners of a run by name, stored as a list of one-name mappings."""
    return {name: options for entry in value or () for name, options in entry.items()}


def _options(mine: Mapping[str, Any], values: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """The options that others have with another value, by their shortest unambiguous names."""
    own, others = dict(settings.leaves(dict(mine))), [dict(settings.leaves(dict(value))) for value in values]
    for key, text in own.items():
        if not key.endswith("_target_") and any(other.get(key, text) != text for other in others):
            parts = key.split(".")
            endings = [".".join(parts[i:]) for i in range(len(parts) - 1, -1, -1)]
            yield next(end for end in endings if sum(f".{other}".endswith(f".{end}") for other in own) == 1), text
