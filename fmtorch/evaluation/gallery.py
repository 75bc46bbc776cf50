"""The pairs that a report shows: images from wherever they lie, each run's matches again, or what it stored."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import torch
from omegaconf import OmegaConf

from fmtorch import data, presets
from fmtorch.data import DataError, ImageError, ImagePair, PairDataset, pair_list, read_image
from fmtorch.evaluation.page import Picture, Shown, ShownPair, differing_pairs
from fmtorch.evaluation.run import PLACES
from fmtorch.io.dataset import WITHOUT_GEOMETRY, H5Pairs
from fmtorch.metrics import corner_error, nsgd
from fmtorch.pipeline import Outcome, Pipeline, build_pipeline, pictures
from fmtorch.pipeline.photographs import Image
from fmtorch.runs import RunFolder
from fmtorch.scenes import RenderedPairs

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
    now, then = again.F.cpu().double(), torch.tensor(stored[column], dtype=torch.float64).reshape(1, 3, 3)
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
    if known["_target_"] not in presets.known_targets() and not options.own_code:
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
    foreign = presets.targets_of(stages) - presets.known_targets()
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
            (outcome,) = pipeline.run([pair], int(r.folder.config.get("seed", 0)))
            note = difference(pair, images, stored, outcome)
            notes += [f"{r.name} {note}"] if note else []
            again = drawn(pair, images, stored, outcome, r.name)
        nsgd, kind = float(stored["nsgd"]) if stored["ok"] else None, stored["pair_type"] or ""
        shown = again or from_stored(pair, images, stored, r.name)
        seen.append(Shown(r.name, nsgd, str(stored["reason"]), shown, kind, stored["corner_error"]))
    return ShownPair(pair.identity, seen, notes)
