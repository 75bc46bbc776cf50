"""`fmtorch match`: the fundamental matrix of two photographs, with pictures; or the pairs of a folder of images."""

import contextlib
import functools
import hashlib
import json
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich.table import Column, Table

from fmtorch import presets
from fmtorch.commands.config import chosen_pipeline, job, run_command
from fmtorch.commands.options import MATCH, MatchOptions
from fmtorch.core import RELATED, files
from fmtorch.core.stages import ImageMatcher
from fmtorch.core.terminal import console, errors, progress_bars
from fmtorch.core.version import __version__
from fmtorch.data.images import read_image, stored_orientation
from fmtorch.evaluation.curves import view_graph_svg
from fmtorch.features.describe import descriptor_kind, image_vector
from fmtorch.io import export, match_store
from fmtorch.jobs.execution import MIN_PAIRS_FOR_PROCESSES
from fmtorch.metrics import nsgd
from fmtorch.pipeline import FolderMatches, MatchResult, PhotographCameras, Pipeline, build_pipeline, match
from fmtorch.pipeline import folder as folders
from fmtorch.presets.composition import execution_of, read_fields
from fmtorch.runs import CachedFeatures, cached, fmtorch_version, image_digest


def match_folder(
    config: DictConfig, fields: MatchOptions, cameras: PhotographCameras, pipeline_name: str, overrides: Sequence[str]
) -> Path:
    """Match the pairs of a folder of images, write what is to be exported and return the folder with it.
    Raises ValueError for what the options cannot mean, and where no pair could be matched."""
    folder = fields.images
    assert folder is not None
    kinds = export.export_kinds(fields.export)
    if fields.camera == "shared" and "colmap" not in kinds:
        raise ValueError("camera=shared needs export=colmap; cameras=shared is what is known of the photographs")
    images = folders.images_below(folder)
    similar = folders.count_of(fields.pairs, folders.SIMILAR)
    pairs = [] if similar else folders.chosen_pairs(folder, images, fields.pairs)
    presets.expect_stages(config)
    stages = presets.stages(config)
    vector = functools.partial(image_vector, kind=descriptor_kind(stages["features"])) if similar else None
    pipeline: Pipeline = build_pipeline(config, presets.resolve_device(fields.device))
    if isinstance(pipeline.matcher, ImageMatcher):
        raise ValueError("images: a folder is matched by keypoints of each image; this matcher takes pairs of images")
    output = fields.output or folders.default_output(folder)
    identity = {
        "version": fmtorch_version(), "images": str(folder.absolute()), **stages, "seed": fields.seed,
        "orient": fields.orient, "longest_side": fields.longest_side, **cameras.identity,
    }  # fmt: skip
    remedy = "choose another output, or delete the folder"
    files.claim(output / folders.RECORD, identity, "matches", remedy, alone=False)
    journal = match_store.MatchStore(output / "export", folder)
    scratch = journal.folder / "features"
    if len(images) > folders.MEMORY and not isinstance(pipeline.extractor, CachedFeatures):  # none is computed twice
        pipeline.extractor = cached(pipeline.extractor, scratch)
    console.print(f"{' '.join([pipeline_name, *overrides])}: {folder}", style="italic")
    count = len(images) * similar if similar else len(pairs)
    many = count >= MIN_PAIRS_FOR_PROCESSES and pipeline.device.type == "cpu"
    execution = execution_of(config, fields.workers).decided(many)
    build = None if execution.shared else functools.partial(build_pipeline, config, pipeline.device)
    with folders.folder_workers(pipeline, execution) as workers, progress_bars() as progress:
        work = FolderMatches(
            pipeline, journal, workers, fields.longest_side, fields.orient, fields.seed, build=build, cameras=cameras,
        )  # fmt: skip
        if similar and vector is not None:
            seen = progress.track(work.images(images), len(images), description="images")
            pairs = folders.similar_pairs(images, folders.vectors_of(seen, vector), similar)
        try:
            for _ in progress.track(work.each(pairs), len(pairs), description=pipeline_name):
                pass
        except KeyboardInterrupt:
            kept = f"{work.done + work.taken} of {len(pairs)} pairs are kept in {output}"
            raise KeyboardInterrupt(f"{kept}; the same command continues") from None
    shutil.rmtree(scratch, ignore_errors=True)
    _expect_pairs(work, len(pairs))
    graph = export.view_graph(journal, images, pairs)
    shared = fields.camera == "shared" or cameras.word == "shared"
    written = ["export.json", *export.write_exports(journal, pairs, kinds, output, shared)]
    written += [*export.write_view_graph(graph, output), _draw_graph(graph, folder, fields.orient, output)]
    _say(work, graph, len(pairs))
    console.print(f"{output}: {', '.join(written)}", style="dim")
    _say_turned(folder, images if "colmap" in kinds and fields.orient else ())
    if isinstance(pipeline.extractor, CachedFeatures) and pipeline.extractor.cache.folder != scratch:
        console.print(pipeline.extractor.report(), style="dim")
    return output


def _expect_pairs(work: FolderMatches, pairs: int) -> None:
    for trouble in work.troubles:
        errors.print(trouble, style="bold", soft_wrap=True)
    for trace in work.tracebacks:
        errors.print(trace, soft_wrap=True)
    if work.taken:
        console.print(f"{work.taken} of {files.counted(pairs, 'pair')} taken from an earlier run")
    if work.troubles and not work.done + work.taken:
        raise ValueError(f"no pair could be matched, the first because: {work.troubles[0]}")


def _say(work: FolderMatches, graph: export.ViewGraph, pairs: int) -> None:
    sizes = [len(part) for part in graph.components() if len(part) > 1]
    apart = len(graph.images) - sum(sizes)
    console.print(f"{work.related} of {pairs} pairs show one scene")
    if sizes:
        others = f"; {apart} image{'s are' if apart > 1 else ' is'} in no related pair" if apart else ""
        console.print(f"connected images: {', '.join(map(str, sizes))}{others}")


def _say_turned(folder: Path, exported: Sequence[Path]) -> None:
    if turned := files.head([f.relative_to(folder).as_posix() for f in exported if stored_orientation(f) != 1]):
        console.print(
            f"turned by their orientation tags: {turned}. Keypoints and cameras in database.db are those of the turned "
            "images, from which COLMAP's mapper works; but COLMAP reads files as they are stored, so that "
            "its colours, undistorted images and dense reconstruction will not fit. Turn the files, or use orient=false"
        )


def _draw_graph(graph: export.ViewGraph, folder: Path, orient: bool, output: Path) -> str:
    def read(name: str) -> NDArray[np.uint8] | None:
        with contextlib.suppress(OSError, ValueError):
            return read_image(folder / name, orient=orient)
        return None

    files.write_whole(output / "graph.svg", view_graph_svg(graph, read))
    return "graph.svg"


def pose_line(result: MatchResult) -> str:
    """``rotation 12.3°, translation (0.98, -0.10, 0.17), focal lengths 702, 702 px``; empty where nobody asked."""
    if result.R is None or result.t is None or result.focals is None or not result.ok:
        return ""
    focals = ", ".join(f"{focal:.0f}" if math.isfinite(focal) else "?" for focal in result.focals.tolist())
    if not bool(torch.isfinite(result.R).all()):
        return f"no pose: it is not determined; focal lengths {focals} px"
    half = (result.R - torch.eye(3).to(result.R)).norm() / math.sqrt(8)  # the sine of half the angle
    angle = math.degrees(2 * math.asin(min(1.0, float(half))))
    direction = ", ".join(f"{value:.3f}" for value in result.t.tolist())
    return f"rotation {angle:.2f}°, translation ({direction}), focal lengths {focals} px"


def lens_line(result: MatchResult) -> str:
    """``lens: lambda -0.102, -0.102; F is of undistorted points``; empty where none bends an image."""
    if result.lens is None or not bool(result.lens.any()):
        return ""
    bending = ", ".join("?" if math.isnan(value) else f"{value:.3f}" for value in result.lens.tolist())
    return f"lens: lambda {bending}; F relates undistorted points, as epipolar.png shows"


MAX_RANK3 = 0.01  # third singular value of a true F over the second one: its numbers may be rounded


def run(config: DictConfig, pipeline_name: str, overrides: Sequence[str] = ()) -> Path:
    """Match the two photographs of a composed config and return the folder with the results.
    overrides: what the command line changed of the pipeline of that name; said beside it."""
    fields = read_fields(MatchOptions, config)
    if fields.images is not None:
        if any(each is not None for each in (fields.image0, fields.image1, fields.truth, fields.lens)):
            raise ValueError("images takes a folder; image0, image1, truth and lens are of a single pair")
        return match_folder(config, fields, PhotographCameras(fields.cameras, fields.K), pipeline_name, overrides)
    if (camera := fields.camera) != "per_image":
        raise ValueError(f"camera is of a folder's database; cameras={camera} is what is known of two photographs")
    if fields.export is not None or str(fields.pairs or folders.EXHAUSTIVE) != folders.EXHAUSTIVE:
        raise ValueError("export and pairs are of a folder of images: give images=FOLDER")
    paths = _given(fields.image0, fields.image1)
    presets.expect_stages(config)
    truth = None if fields.truth is None else read_matrix(fields.truth)
    cameras = PhotographCameras(fields.cameras, fields.K)
    images = [read_image(cameras.source(path), orient=fields.orient) for path in paths]
    ends = [cameras.of(path, image.shape[:2]) for path, image in zip(paths, images, strict=True)]
    knowledge = cameras.knowledge(*ends)
    if fields.lens is not None and "lens" in knowledge:
        raise ValueError(f"lens={fields.lens} and cameras with a calibrated lens are given: leave one of them out")
    settings = {
        "pipeline": pipeline_name, "overrides": list(overrides), "seed": fields.seed, "orient": fields.orient,
        "longest_side": fields.longest_side, "truth": None if fields.truth is None else str(fields.truth),
        "cameras": cameras.identity.get("cameras"), "lens": fields.lens, "digests": [*map(image_digest, images)],
    }  # fmt: skip
    folder = _output(fields.output, paths, settings)
    files.expect_writable(folder)
    pipeline: Pipeline = build_pipeline(config, presets.resolve_device(fields.device))
    options = {"longest_side": fields.longest_side, "seed": fields.seed, "lens": fields.lens, **knowledge}
    result = match(*images, pipeline=pipeline, **options)
    error = None if truth is None or not result.ok else _nsgd(result, truth)
    report = {"version": __version__, **settings, "image0": str(paths[0]), "image1": str(paths[1])}
    written = result.save(folder, truth=truth, report=report | ({} if error is None else {"nsgd": error}))
    console.print(f"{' '.join([pipeline_name, *overrides])}: {paths[0].name}, {paths[1].name}", style="italic")
    extractor = pipeline.extractor
    console.print(_table(result, isinstance(extractor, CachedFeatures) and not extractor.computed))
    if result.related:
        console.print(_verdict(result), style="bold", soft_wrap=True)
    if error is not None:
        console.print(f"NSGD to the true F: {error:.4f}")
    for line in filter(None, (pose_line(result), lens_line(result))):
        console.print(line)
    for trouble in (*filter(None, (end.note for end in ends)), *_troubles(result)):
        errors.print(trouble, style="bold", soft_wrap=True)
    console.print(f"{folder}: {', '.join(written)}", style="dim")
    if isinstance(pipeline.extractor, CachedFeatures):
        console.print(pipeline.extractor.report(), style="dim")
    return folder


def read_matrix(path: Path) -> NDArray[np.float64]:
    """The 3 x 3 matrix of a text file of nine numbers, row by row. Raises ValueError for a file of anything else."""
    try:
        words = path.read_text().replace(",", " ").split()
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise ValueError(f"{path}: {error}; it must hold nine numbers, F row by row") from error
    if numbers.shape != (9,) or not np.isfinite(numbers).all() or not numbers.any():
        raise ValueError(f"{path}: holds {len(words)} numbers; it must hold nine finite ones, F row by row")
    F = numbers.reshape(3, 3)
    singular = np.linalg.svd(F, compute_uv=False)
    if singular[2] > MAX_RANK3 * singular[1]:
        raise ValueError(f"{path}: a matrix of rank three (its determinant is not 0); F has rank two")
    return F


def _given(*images: Path | None) -> list[Path]:
    """The two photographs. Raises ValueError where one is missing, or a folder stands for it."""
    for path in filter(None, images):
        if path.is_dir():
            raise ValueError(f"{path} is a folder; fmtorch match images={path} matches its images with one another")
    missing = [f"image{i}" for i, image in enumerate(images) if image is None]
    if missing:
        raise ValueError(f"{missing[0]} is missing; give two image files: fmtorch match a.jpg b.jpg")
    return list(filter(None, images))


def _output(given: Path | None, paths: Sequence[Path], settings: Mapping[str, Any]) -> Path:
    """The folder that is given, or ``matches/NAME0-NAME1``, with some digits behind where that holds other images of
    these names or settings. Raises ValueError where the given one does, or is that of a folder."""
    folder, earlier = given or Path(f"matches/{paths[0].stem}-{paths[1].stem}"), dict[str, Any]()
    with contextlib.suppress(OSError, ValueError, TypeError):
        earlier = dict(json.loads((folder / "result.json").read_text()))
    images = [str(path.absolute()) for path in paths]
    same = [str(Path(str(earlier.get(name))).absolute()) for name in ("image0", "image1")] == images
    free = not earlier or (same and all(earlier.get(name) == value for name, value in settings.items()))
    if free and (given is None or not (given / folders.RECORD).exists()):
        return folder
    if given is not None:
        raise ValueError(f"output={given} holds the matches of other images or settings; choose another, or delete it")
    identity = files.canonical({"images": images, **settings})
    return folder.with_name(f"{folder.name}-{hashlib.blake2b(identity.encode(), digest_size=4).hexdigest()}")


def _nsgd(result: MatchResult, truth: NDArray[np.float64]) -> float:
    c = result.correspondences
    sizes = (torch.as_tensor(size).cpu() for size in (c.size0, c.size1))
    return float(nsgd(torch.from_numpy(truth)[None], result.F.cpu()[None], *sizes)[0])


def _verdict(result: MatchResult) -> str:
    inliers, matches = int(result.inliers.sum()), result.correspondences.mask.shape[1]
    support = f"related: {inliers:,} of {matches:,} matches are inliers of F"
    return f"{support}, significance {result.significance:.0f}, pair type {result.pair_type}"


def _troubles(result: MatchResult) -> list[str]:
    warning = result.warning if result.related or result.pair_type != "unrelated" else ""  # which is said already
    if not result.ok:
        return list(filter(None, (f"no F: {result.reason}", warning)))
    chance = (
        "probably not the same scene: unrelated photographs have as much support by chance "
        f"(significance {result.significance:.1f}; related from {RELATED:g} on)"
    )
    return list(filter(None, ("" if result.related else chance, warning)))


def _table(result: MatchResult, cached: bool) -> Table:
    """What each step left and took; cached: the features were computed by an earlier run, which took the seconds."""
    table = Table("step", Column("left", justify="right"), Column("seconds", justify="right"))
    for step, seconds in result.seconds.items():
        left, taken = f"{result.counts.get(step, 0):,} matches", f"{seconds:.3f}"
        if step == "features":
            left = f"{len(result.keypoints0):,} + {len(result.keypoints1):,} keypoints"
            taken = "cached" if cached else taken
        elif step in ("estimation", "pair_type"):
            left = result.pair_type if step == "pair_type" else left.replace("matches", "inliers")
        table.add_row(step, left, taken)
    return table


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config, *chosen_pipeline())


main = functools.partial(run_command, MATCH, task)
