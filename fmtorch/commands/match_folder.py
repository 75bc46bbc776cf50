"""`fmtorch match images=FOLDER export=h5,colmap`: the pairs of a folder of images, for other programs."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from fmtorch import presets
from fmtorch.commands.options import MatchOptions
from fmtorch.core.files import replacing
from fmtorch.core.settings import head
from fmtorch.core.stages import ImageMatcher
from fmtorch.core.terminal import console, errors, progress_bars
from fmtorch.data.images import read_image, stored_orientation
from fmtorch.evaluation.view_graph_picture import view_graph_svg
from fmtorch.features.vlad import descriptor_kind, image_vector
from fmtorch.io.export import ViewGraph, export_kinds, view_graph, write_exports, write_view_graph
from fmtorch.io.match_store import MatchStore
from fmtorch.jobs.execution import MIN_PAIRS_FOR_PROCESSES
from fmtorch.pipeline.build import build_pipeline
from fmtorch.pipeline.folder import (
    MEMORY,
    SIMILAR,
    FolderMatches,
    chosen_pairs,
    count_of,
    default_output,
    folder_workers,
    images_below,
    open_folder,
    similar_pairs,
    vectors_of,
)
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets.executors import execution_of
from fmtorch.runs.feature_cache import CachedFeatures, cached
from fmtorch.runs.fingerprint import fmtorch_version


def match_folder(
    config: DictConfig, fields: MatchOptions, cameras: PhotographCameras, pipeline_name: str, overrides: Sequence[str]
) -> Path:
    """Match the pairs of a folder of images, write what is to be exported and return the folder with it.

    Raises ValueError for what the options cannot mean, and where no pair could be matched.
    """
    folder = fields.images
    assert folder is not None
    kinds = export_kinds(fields.export)
    images = images_below(folder)
    similar = count_of(fields.pairs, SIMILAR)
    pairs = [] if similar else chosen_pairs(folder, images, fields.pairs)
    presets.expect_stages(config)
    stages = presets.stages(config)
    vector = functools.partial(image_vector, kind=descriptor_kind(stages["features"])) if similar else None
    pipeline: Pipeline = build_pipeline(config, presets.resolve_device(fields.device))
    if isinstance(pipeline.matcher, ImageMatcher):
        raise ValueError("images: a folder is matched by keypoints of each image; this matcher takes pairs of images")
    output = fields.output or default_output(folder)
    identity = {
        "version": fmtorch_version(), "images": str(folder.absolute()), **stages, "seed": fields.seed,
        "orient": fields.orient, "longest_side": fields.longest_side, **cameras.identity,
    }  # fmt: skip
    journal = MatchStore(open_folder(output, identity), folder)
    scratch = journal.folder / "features"
    if len(images) > MEMORY and not isinstance(pipeline.extractor, CachedFeatures):  # none is computed twice
        pipeline.extractor = cached(pipeline.extractor, scratch)
    console.print(f"{' '.join([pipeline_name, *overrides])}: {folder}", style="italic", markup=False, highlight=False)
    count = len(images) * similar if similar else len(pairs)
    many = count >= MIN_PAIRS_FOR_PROCESSES and pipeline.device.type == "cpu"
    execution = execution_of(config, fields.workers).decided(many)
    build = None if execution.shared else functools.partial(build_pipeline, config, pipeline.device)
    with folder_workers(pipeline, execution) as workers, progress_bars() as progress:
        work = FolderMatches(
            pipeline, journal, fields.longest_side, fields.orient, fields.seed,
            workers=workers, build=build, cameras=cameras,
        )  # fmt: skip
        if similar and vector is not None:
            seen = progress.track(work.images(images), len(images), description="images")
            pairs = similar_pairs(images, vectors_of(seen, vector), similar)
        for _ in progress.track(work.each(pairs), len(pairs), description=pipeline_name):
            pass
    shutil.rmtree(scratch, ignore_errors=True)
    _expect_some(work, len(pairs))
    graph = view_graph(journal, images, pairs)
    shared = fields.camera == "shared" or cameras.word == "shared"
    written = ["export.json", *write_exports(journal, pairs, kinds, output, shared)]
    written += [*write_view_graph(graph, output), _draw(graph, folder, fields.orient, output)]
    _say(work, graph, len(pairs))
    console.print(f"{output}: {', '.join(written)}", style="dim", markup=False, highlight=False)
    if "colmap" in kinds and fields.orient:
        _say_turned(images, folder)
    if isinstance(pipeline.extractor, CachedFeatures) and pipeline.extractor.cache.folder != scratch:
        console.print(pipeline.extractor.report(), style="dim", markup=False, highlight=False)
    return output


def _expect_some(work: FolderMatches, pairs: int) -> None:
    """Say what went wrong with images and pairs, and raise ValueError where no pair could be matched."""
    for trouble in work.troubles:
        errors.print(trouble, style="bold", markup=False, highlight=False, soft_wrap=True)
    if work.taken:
        console.print(f"{work.taken} of {pairs} pairs taken from an earlier run", highlight=False)
    if work.troubles and not work.done + work.taken:
        raise ValueError(f"no pair could be matched, the first because: {work.troubles[0]}")


def _say(work: FolderMatches, graph: ViewGraph, pairs: int) -> None:
    sizes = [len(part) for part in graph.components() if len(part) > 1]
    apart = len(graph.images) - sum(sizes)
    console.print(f"{work.related} of {pairs} pairs show one scene", highlight=False)
    if sizes:
        others = f"; {apart} images are in no related pair" if apart else ""
        console.print(f"connected images: {', '.join(map(str, sizes))}{others}", highlight=False)


def _say_turned(images: Sequence[Path], folder: Path) -> None:
    """Say what COLMAP makes of photographs that were turned."""
    turned = [image.relative_to(folder).as_posix() for image in images if stored_orientation(image) != 1]
    if turned:
        console.print(
            f"turned by their orientation tags: {head(turned)}. Keypoints and cameras in database.db are those of the "
            "turned images, from which COLMAP's mapper works; but COLMAP reads files as they are stored, so that its "
            "colours, undistorted images and dense reconstruction will not fit. Turn the files, or use orient=false",
            highlight=False,
        )


def _draw(graph: ViewGraph, folder: Path, orient: bool, output: Path) -> str:
    """Draw the graph; the name of the picture."""

    def read(name: str) -> NDArray[np.uint8] | None:
        try:
            return read_image(folder / name, orient=orient)
        except (OSError, ValueError):
            return None

    with replacing(output / "graph.svg") as path:
        path.write_text(view_graph_svg(graph, read), encoding="utf-8")
    return "graph.svg"
