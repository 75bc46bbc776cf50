"""`python -m fmtorch.match images=FOLDER export=h5,colmap`: the pairs of a folder of images, for other programs."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from omegaconf import DictConfig

from fmtorch import presets
from fmtorch.core.terminal import console, errors, progress_bars
from fmtorch.pipeline.folder import MEMORY, FolderMatches
from fmtorch.pipeline.folder_images import chosen_pairs, images_below
from fmtorch.pipeline.folder_output import default_output, open_folder
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets.fields import Count, Device, Seed
from fmtorch.storage.code import fmtorch_version
from fmtorch.storage.exchange.export import export_kinds, write_exports
from fmtorch.storage.exchange.journal import Journal
from fmtorch.storage.features import CachedFeatures, cached


@dataclasses.dataclass(frozen=True)
class FolderFields:
    """What the command takes of a folder, and of a single pair too; ``conf/match.yaml`` says what each is."""

    images: Path | None = None
    pairs: Path | None = None
    export: str | list[str] | None = None
    camera: Literal["per_image", "shared"] = "per_image"
    output: Path | None = None
    orient: bool = True
    longest_side: Count = 1600
    workers: Count | None = None
    seed: Seed = 0
    device: Device = "auto"


def match_folder(
    config: DictConfig, fields: FolderFields, cameras: PhotographCameras, pipeline_name: str, overrides: Sequence[str]
) -> Path:
    """Match the pairs of a folder of images, write what is to be exported and return the folder with it.

    Raises ValueError for what the options cannot mean, and where no pair could be matched.
    """
    folder = fields.images
    assert folder is not None
    kinds = export_kinds(fields.export)
    images = images_below(folder)
    pairs = chosen_pairs(folder, images, fields.pairs)
    presets.expect_stages(config)
    pipeline: Pipeline = presets.build_pipeline(config, presets.resolve_device(fields.device))
    output = fields.output or default_output(folder)
    identity = {
        "version": fmtorch_version(), "images": str(folder.absolute()), **presets.stages(config), "seed": fields.seed,
        "orient": fields.orient, "longest_side": fields.longest_side, **cameras.identity,
    }  # fmt: skip
    journal = Journal(open_folder(output, identity), folder)
    scratch = journal.folder / "features"
    if len(images) > MEMORY and not isinstance(pipeline.extractor, CachedFeatures):  # none is computed twice
        pipeline.extractor = cached(pipeline.extractor, scratch)
    console.print(f"{' '.join([pipeline_name, *overrides])}: {folder}", style="italic", markup=False, highlight=False)
    work = FolderMatches(
        pipeline, journal, fields.longest_side, fields.orient, fields.seed, workers=fields.workers, cameras=cameras
    )
    with progress_bars() as progress:
        bar = progress.add_task(pipeline_name, total=len(pairs))
        for _ in work.each(pairs):
            progress.advance(bar)
    shutil.rmtree(scratch, ignore_errors=True)
    for trouble in work.troubles:
        errors.print(trouble, style="bold", markup=False, highlight=False, soft_wrap=True)
    if work.taken:
        console.print(f"{work.taken} of {len(pairs)} pairs taken from an earlier run", highlight=False)
    if work.troubles and not work.done + work.taken:
        raise ValueError(f"no pair could be matched, the first because: {work.troubles[0]}")
    console.print(f"{work.related} of {len(pairs)} pairs show one scene", highlight=False)
    shared = fields.camera == "shared" or cameras.word == "shared"
    written = ["export.json", *write_exports(journal, pairs, kinds, output, shared)]
    console.print(f"{output}: {', '.join(written)}", style="dim", highlight=False)
    if isinstance(pipeline.extractor, CachedFeatures) and pipeline.extractor.cache.folder != scratch:
        console.print(pipeline.extractor.report(), style="dim", highlight=False)
    return output
