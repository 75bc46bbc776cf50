"""`python -m fmtorch.eval pipeline=sift_ratio`: run a pipeline over a data set of image pairs and evaluate it."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import data, presets
from fmtorch.commands.main import job, run_command
from fmtorch.core.terminal import console, progress_bars, reporter
from fmtorch.data import ImagePair, PairDataset
from fmtorch.evaluation.identity import run_identity
from fmtorch.evaluation.plots import plot_recall_curves
from fmtorch.evaluation.run import evaluate_pairs, select
from fmtorch.evaluation.summary import ALL, summarize
from fmtorch.evaluation.summary_tables import pose_table, summary_markdown, summary_table
from fmtorch.pipeline.exporting import exportable
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets import plain
from fmtorch.presets.fields import Cache, Count, Device, Gigabytes, Seed, path_fields, read_fields
from fmtorch.storage import RunFolder, identity_digest
from fmtorch.storage.exchange.export import export_kinds, write_exports
from fmtorch.storage.exchange.journal import Journal
from fmtorch.storage.features import CachedFeatures

MANY = 500  # pairs from which on processes are worth their start
MOST_PROCESSES = 8  # unless more are asked for: each holds the networks of the pipeline and some 0.5 GB


@dataclasses.dataclass(frozen=True)
class Fields:
    """What the command takes beside stages and the data set; ``conf/eval.yaml`` says what each is."""

    limit: Count | None = None
    seed: Seed = 0
    device: Device = "auto"
    batch: Count = 16
    workers: Count | None = None
    processes: bool | None = None
    run_dir: Path | None = None
    cache: Cache = None
    cache_limit: Gigabytes | None = 20
    export: str | list[str] | None = None


def run(config: DictConfig, pipeline_name: str) -> Path:
    """Evaluate one composed config and return the run folder.

    Raises ValueError, before anything is computed or written, where an option is not what it may be.
    """
    fields = read_fields(Fields, config)
    device = presets.resolve_device(fields.device)
    kinds = export_kinds(fields.export)
    presets.expect_dataset(config.dataset)
    presets.expect_stages(config)
    with progress_bars() as progress:
        pipeline: Pipeline = presets.build_pipeline(config, device)
        dataset = _load(config.dataset, progress)
        identity = run_identity(config, pipeline_name, pipeline, dataset.digest)
        name = f"{pipeline_name}-{identity_digest(identity)[:8]}"
        folder = RunFolder.open(fields.run_dir or Path(f"runs/{dataset.name}/{name}"), identity)
        chosen = select([dataset[i] for i in range(len(dataset))], fields.limit)
        done = folder.done()
        journal = _journal(folder.path, chosen) if kinds else None
        todo = [p for p in chosen if p.key not in done or (journal is not None and _to_export(journal, p))]
        processes = len(todo) >= MANY if fields.processes is None else fields.processes
        processes = processes and device.type == "cpu"
        cores = os.cpu_count() or 1
        workers = fields.workers or (1 if device.type != "cpu" else min(cores, MOST_PROCESSES) if processes else cores)
        bar = progress.add_task(pipeline_name, total=len(chosen), completed=len(chosen) - len(todo))
        build = functools.partial(presets.build_pipeline, config, device) if processes and workers > 1 else None
        for count in evaluate_pairs(
            pipeline, todo, seed=fields.seed, batch=fields.batch, workers=workers, store=folder.append, build=build,
            journal=journal,
        ):  # fmt: skip
            progress.advance(bar, count)
    if len(todo) < len(chosen):
        taken = f"{len(chosen) - len(todo)} of {len(chosen)} pairs taken from an earlier run in {folder.path}"
        console.print(taken, markup=False, highlight=False)
    keys = {pair.key for pair in chosen}
    table = folder.read(keys)
    summary = summarize(table)
    folder.write_summary(summary, summary_markdown(summary, title=f"{pipeline_name} on {dataset.name}"))
    plot_recall_curves({pipeline_name: table}, folder.path / "recall.png")
    console.print(summary_table(summary, title=f"{pipeline_name} on {dataset.name}"))
    if (poses := pose_table(summary)) is not None:
        console.print(poses)
    console.print(f"[dim]{folder.path}: pairs/, summary.json, summary.md, recall.png[/dim]")
    if journal is not None:
        ends = [(p.image0.path, p.image1.path) for p in chosen if exportable(p)]
        written = write_exports(journal, ends, kinds, folder.path)
        console.print(f"[dim]{folder.path}: {', '.join(written)}; names of images are below {journal.root}[/dim]")
    if isinstance(pipeline.extractor, CachedFeatures):
        console.print(f"[dim]{pipeline.extractor.report()}[/dim]")
    if chosen and summary[ALL]["failures"] == len(chosen):
        reason = next(iter(table["reason"].to_pylist()))
        raise ValueError(
            f"every pair failed, the first because: {reason}. Once that is mended, delete {folder.path} to run again"
        )
    return folder.path


def _journal(folder: Path, pairs: Sequence[ImagePair]) -> Journal:
    """Where what is to be exported is kept. Raises ValueError where no pair has images to name."""
    parents = {str(image.path.absolute().parent) for p in pairs if exportable(p) for image in (p.image0, p.image1)}
    if not parents:
        raise ValueError("export: no pair has images in which a pipeline finds keypoints")
    return Journal(folder / "export", Path(os.path.commonpath(sorted(parents))))


def _to_export(journal: Journal, pair: ImagePair) -> bool:
    """Whether a pair's matches are not in the journal yet, and its images are there."""
    ends = pair.image0.path, pair.image1.path
    return exportable(pair) and all(path.is_file() for path in ends) and not journal.has_pair(*ends)


def _load(config: DictConfig, progress: Progress) -> PairDataset:
    """The data set of a config; the embedded one is drawn on first use, which the progress bar shows."""
    options = plain(config)
    if "_target_" in options:  # somebody's own data set
        dataset: PairDataset = presets.instantiate(options, "dataset")
        return dataset
    return data.load(**options, progress=reporter(progress, "drawing scenes"))


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config, str(HydraConfig.get().runtime.choices["pipeline"]))


def main() -> None:
    """The command."""
    paths = [*path_fields(Fields), "dataset.root", "dataset.truth", "dataset.images", "export"]
    run_command("eval", task, paths=paths, interrupted="interrupted; the same command continues the run")
