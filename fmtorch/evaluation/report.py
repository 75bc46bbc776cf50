"""The report of several runs on one HTML page: tables, paired differences, curves, and pictures of pairs.

Images of pairs are read from wherever they lie; of each run they show its matches again, or the F that it stored."""

import base64
import dataclasses
import hashlib
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pyarrow as pa
import torch
from omegaconf import OmegaConf

from fmtorch import data, presets
from fmtorch.core import files, lazy
from fmtorch.data import DataError, ImageError, ImagePair, PairDataset, pair_list, read_image
from fmtorch.evaluation import curves, statistics, tables
from fmtorch.evaluation.run import PLACES, informed
from fmtorch.io.dataset import WITHOUT_GEOMETRY, H5Pairs
from fmtorch.metrics import corner_error, nsgd
from fmtorch.pipeline import Outcome, Pipeline, build_pipeline, pictures
from fmtorch.pipeline.photographs import Image
from fmtorch.runs import RunFolder
from fmtorch.scenes import RenderedPairs

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
        return pictures.jpeg_url(image, QUALITY), image.shape[1], image.shape[0]


class Shown(NamedTuple):
    """A pair as a run sees it. nsgd: None if it failed. pair_type: "" if unknown. corner_error: px, of homographies."""

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
    notes: what to know of the pictures of pairs, or why there are none. signed: runs in which the sign of t counts."""

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
    return [names[rows[i]] for i in order[np.argsort(turns, kind="stable")][:count]]


def _context(section: Section, names: Sequence[str]) -> dict[str, Any]:
    summaries = {name: statistics.summarize(table, name in section.signed) for name, table in section.runs.items()}
    axis = curves.axis_of(section.runs)
    pairs = {table.num_rows for table in section.runs.values()}
    facts = f"{len(section.runs)} runs" if len(section.runs) > 1 else "One run"
    counts = f"{min(pairs):,}" + (f" to {max(pairs):,}" if len(pairs) > 1 else "")
    return {
        "heading": section.heading, "pairs": section.pairs, "notes": section.notes,
        "facts": f"{facts}, {counts} pair{'s' * (pairs != {1})}{' each' * (len(section.runs) > 1)}.",
        "legend": tables.caption(next(iter(summaries.values()))),
        "tables": tables.report_tables(section.runs, summaries), "names": list(section.runs), "axis": axis.label,
        "curves": [(name, curves.svg(name, panel, names, axis)) for name, panel in curves.panels(section.runs).items()],
    }  # fmt: skip


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
            yield from _words(dict(_options(own, [{**own, **other} for other in others])))
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
    others = [dict(files.leaves(dict(value))) for value in values]
    options = dict(_options(mine, alike)) or {
        key: text for key, text in changed.items() if not others or any(other.get(key) != text for other in others)
    }
    if len(alike) < len(values) or not options or not values:
        yield kind
    yield from _words(options)


def _kind(group: str, value: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """The preset from which a stage differs least, and the options in which it does; without one its class."""
    close = presets.files.closest(group, value)
    if close is None:
        return str(value.get("_target_", group)).rpartition(".")[2], {}
    return close[0], {key: text for key, text in files.leaves(close[1]) if key}


def _words(options: Mapping[str, str]) -> list[str]:
    words = [f"{key}={text.strip(chr(34))}" for key, text in options.items()]
    return words if len(words) <= MAX_OPTIONS else []


def _pruners(value: Any) -> dict[str, Any]:
    """The pruners of a run by name, stored as a list of one-name mappings."""
    return {name: options for entry in value or () for name, options in entry.items()}


def _options(mine: Mapping[str, Any], values: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """The options that others have with another value or not at all, by their shortest unambiguous names."""
    own, *others = (dict(_leaves(value)) for value in (mine, *values))
    for key, text in own.items():
        if key != "_target_" and any(other.get(key) != text for other in others):
            parts = key.split(".")
            endings = [".".join(parts[i:]) for i in range(len(parts) - 1, -1, -1)]
            yield next(end for end in endings if sum(f".{other}".endswith(f".{end}") for other in own) == 1), text


def _leaves(value: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Options and their texts; of one that is itself an object its class as well."""
    for key, text in files.leaves(dict(value)):
        option = key.removesuffix("._target_")
        yield option, text if option == key else text.rpartition(".")[2]


Row = Mapping[str, Any]  # what a run stored of a pair
SAME_CORNERS = 0.01  # px, corner error up to which two homographies are the same: what captions show
SAME_NSGD = 1e-4  # between the F of a run and the one drawn again, up to which they are the same: what captions show


def difference(pair: ImagePair, images: Sequence[Image], stored: Row, outcome: Outcome) -> str:
    """What differs between the row of a pair and what its pipeline makes of it now; empty where nothing does."""
    again, planar = outcome.estimate, pair.H is not None
    name, column = ("homography", "H") if planar else ("F", "F")
    if again is None or not bool(again.ok[0]):
        return f"gives no {name} when it is drawn again ({outcome.reason}), unlike in its run" if stored["ok"] else ""
    if not stored["ok"]:
        return f"gives {'a' if planar else 'an'} {name} when it is drawn again, unlike in its run"
    now, then = again.matrix.cpu().double(), torch.tensor(stored[column], dtype=torch.float64).reshape(1, 3, 3)
    sizes = [torch.tensor([image.shape[:2]]) for image in images]
    if planar:
        apart = float(corner_error(now, then, sizes[0])[0])
        return "" if apart <= SAME_CORNERS else f"gives another {name} when it is drawn again, {apart:.2f} px apart"
    F, key = torch.from_numpy(pair.F)[None], torch.tensor([pair.key])
    apart, error = (float(nsgd(other, now, *sizes, key=key)[0]) for other in (then, F))
    if apart <= SAME_NSGD:
        return ""
    return (
        f"gives another F when it is drawn again: NSGD {error:.4f}, in its run {stored['nsgd']:.4f}; the two are "
        f"{apart:.4f} apart. Its matches below are those of now, its epipolar lines those of the run"
    )


def drawn(pair: ImagePair, images: Sequence[Image], stored: Row, outcome: Outcome, name: str) -> list[Picture]:
    """A run's matches of a pair, drawn again, and the epipolar lines of the F that it stored.
    Of a pair that has no F, its matches; nothing where there are none, or none of an F that was stored."""
    c, estimate = outcome.correspondences, outcome.estimate
    if c is None or estimate is None or (stored["ok"] and not bool(estimate.ok[0])):
        return []
    x0, x1 = (x[0].cpu().numpy().astype(np.float64) for x in (c.x0, c.x1))
    inliers = estimate.inliers[0].cpu().numpy() & bool(stored["ok"])
    matches = pictures.draw_matches(images[0], images[1], x0, x1, inliers)
    matrix = "F" if pair.H is None else "H"
    said = f"{int(inliers.sum())} inliers of {matrix} (green) of {len(inliers)} matches; a sample of either is drawn"
    shown = [Picture(matches, f"matches of {name}", said)]
    if stored["ok"] and pair.H is None:
        F = np.array(stored["F"]).reshape(3, 3)
        lines = pictures.draw_epipolar_lines(images[0], images[1], x0[inliers], x1[inliers], F, truth=pair.F)
        said = "Epipolar lines of some inliers; the true ones dashed in white"
        shown.append(Picture(lines, f"epipolar lines of {name}", said))
    return shown


def from_stored(pair: ImagePair, images: Sequence[Image], stored: Row, name: str) -> list[Picture]:
    """The epipolar lines of the F that a run stored, of corners of the images; nothing of a pair without F."""
    if not stored["ok"] or pair.H is not None:
        return []
    F = np.array(stored["F"]).reshape(3, 3)
    lines = pictures.draw_epipolar_lines_of_corners(images[0], images[1], F, truth=pair.F)
    said = "Epipolar lines of some corners, each in the other image, by the stored F; the true ones dashed in white"
    return [Picture(lines, f"epipolar lines of {name}", said)]


MAX_RUNS = 8  # whose pictures a pair has: each adds some 0.4 MB to the page
_NOT_BUILT = (ValueError, TypeError, AttributeError, ImportError, OSError)


class Run(NamedTuple):
    """A run folder, its results, and how the page calls it."""

    name: str
    folder: RunFolder
    table: pa.Table


@dataclasses.dataclass(frozen=True)
class Options:
    """What a report may use for its pictures.
    roots: folders where images may lie; which data set is in which shows by its digest. own_code: whether parts and
    data sets that are not this project's are loaded, which runs their code. cache, cache_limit: of features."""

    count: int
    roots: Sequence[Path] = ()
    own_code: bool = False
    device: torch.device = dataclasses.field(default_factory=lambda: torch.device("cpu"))
    cache: str | None = None
    cache_limit: int | float | None = None


def gallery(
    runs: Sequence[Run], options: Options, progress: Callable[[Sequence[str]], Any] = lambda pairs: pairs
) -> tuple[list[ShownPair], list[str]]:
    """Pairs of one data set as each run sees them, and what the reader should know of them, or why there are none."""
    wanted = differing_pairs({r.name: r.table for r in runs}, options.count)
    if not wanted:
        return [], [] if options.count == 0 else ["No pictures: the runs share no pair."]
    try:
        dataset = find_dataset(runs[0].folder.config.get("dataset") or {}, options)
    except _NOT_BUILT as error:
        return [], [f"No pictures: {error}"]
    pairs = {dataset[i].identity: dataset[i] for i in range(len(dataset))}
    notes = []
    if len(runs) > MAX_RUNS:
        notes.append(f"Pictures are of the first {MAX_RUNS} of {len(runs)} runs.")
    pipelines: dict[str, Pipeline | None] = {}
    for r in runs[:MAX_RUNS]:
        try:
            pipelines[r.name] = rebuilt(r, options)
        except _NOT_BUILT as error:
            pipelines[r.name] = None
            notes.append(f"{r.name} is shown by the F that it stored, without its matches: {error}.")
    shown = [shown_pair(pairs[name], runs[:MAX_RUNS], pipelines) for name in progress(wanted) if name in pairs]
    return shown, notes if shown else ["No pictures: the data set does not hold the pairs of the runs."]


def find_dataset(stored: Row, options: Options) -> PairDataset:
    """The data set that a run evaluated, in the first of the roots that holds it.
    stored: its config and digest in the run's identity. A run of others' results, which names no data set, is looked
    for in the roots in the layout of `fmbench`. Raises DataError where it is another or nowhere to be found."""
    known = {key: value for key, value in stored.items() if key != "digest"}
    if "_target_" not in known:
        known = presets.load("dataset", "fmbench")
    if known["_target_"] not in presets.files.known_targets() and not options.own_code:
        raise DataError("the data set is one of your own, which a report loads with own_code=true")
    reasons = []
    for place in _places(known, options.roots):
        try:
            dataset = data.build({**known, **place})
            if stored.get("digest") in (None, dataset.digest):
                return dataset
            reasons.append("the data set has changed since the run, or another one lies in root")
        except _NOT_BUILT as error:
            reasons.append(str(error))
    raise DataError("; ".join(dict.fromkeys(reasons)))


def _places(known: Mapping[str, Any], roots: Sequence[Path]) -> list[dict[str, Any]]:
    """The options that say where a data set, and what it needs beside itself, may lie."""
    target = presets.target_of(known, "dataset")
    taken = [name for name in PLACES if name in inspect.signature(target).parameters] or ["root"]
    places: list[dict[str, Any]] = [{taken[0]: root} for root in roots]
    if target is pair_list.PairList:
        places = [{"root": r, "file": f} for r in roots if r.is_dir() for f in roots if f.is_file()]
    elif target is H5Pairs:
        other = "truth" if known.get("layout") in WITHOUT_GEOMETRY else "images"
        places = [*({"root": root, other: place} for root in roots for place in roots if place != root), *places]
    elif target is RenderedPairs:  # which is drawn where it does not lie, and never among something else
        drawn = f"*-{known.get('split', 'test')}-{known.get('size', 'small')}-*"
        places = [place for place in places if any(place["root"].glob(drawn))]
    else:
        places.append({})  # its usual place
    return places or [{}]


def rebuilt(r: Run, options: Options) -> Pipeline:
    """The pipeline of a run. Raises ValueError for parts that are not the project's own, unless these are allowed."""
    stages = {group: r.folder.config[group] for group in presets.STAGES if group in r.folder.config}
    if not stages:
        raise ValueError("its folder does not say what its pipeline was")
    foreign = presets.files.targets_of(stages) - presets.files.known_targets()
    if foreign and not options.own_code:
        own = ", ".join(sorted(foreign))
        raise ValueError(f"it has parts of your own ({own}), which a report loads with own_code=true")
    cache = {"cache": options.cache, "cache_limit": options.cache_limit}
    return build_pipeline(OmegaConf.create({**presets.composed(stages), **cache}), options.device, None)


def shown_pair(pair: ImagePair, runs: Sequence[Run], pipelines: Mapping[str, Pipeline | None]) -> ShownPair:
    """A pair as each run sees it: drawn again by its pipeline, or where there is none by the F that it stored."""
    try:
        images = [read_image(source) for source in (pair.image0, pair.image1)]
    except ImageError as error:
        return ShownPair(pair.identity, [], [str(error)])
    seen, notes = [], []
    for r in runs:
        stored = next(row for row in r.table.to_pylist() if row["key"] == pair.key)
        pipeline = pipelines[r.name]
        again: list[Picture] = []
        if pipeline is not None:
            given = informed([pair], r.folder.config.get("cameras"), r.folder.config.get("lens"))
            (outcome,) = pipeline.run(given, int(r.folder.config.get("seed", 0)))
            note = difference(pair, images, stored, outcome)
            notes += [f"{r.name} {note}"] if note else []
            again = drawn(pair, images, stored, outcome, r.name)
        nsgd, kind = float(stored["nsgd"]) if stored["ok"] else None, stored["pair_type"] or ""
        shown = again or from_stored(pair, images, stored, r.name)
        seen.append(Shown(r.name, nsgd, str(stored["reason"]), shown, kind, stored["corner_error"]))
    return ShownPair(pair.identity, seen, notes)
