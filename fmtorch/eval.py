"""`python -m fmtorch.eval pipeline=sift_ratio`: run a pipeline over a data set of image pairs and evaluate it."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import data, presets
from fmtorch.command import console, exits_with_message, plain, progress_bars, reporter
from fmtorch.data import PairDataset
from fmtorch.evaluation.identity import run_identity
from fmtorch.evaluation.plots import plot_recall_curves
from fmtorch.evaluation.run import evaluate_pairs, select
from fmtorch.evaluation.summary import ALL, summarize, summary_markdown, summary_table
from fmtorch.resources import conf_dir
from fmtorch.storage import RunFolder, identity_digest
from fmtorch.storage.features import CachedFeatures

MANY = 500  # pairs from which on processes are worth their start
MOST_PROCESSES = 8  # unless more are asked for: each holds the networks of the pipeline and some 0.5 GB


def run(config: DictConfig, pipeline_name: str) -> Path:
    """Evaluate one composed config and return the run folder."""
    device = presets.resolve_device(config.device)
    with progress_bars() as progress:
        dataset = _load(config.dataset, progress)
        pipeline = presets.build_pipeline(config, device)
        identity = run_identity(config, pipeline_name, pipeline, dataset.digest)
        name = f"{pipeline_name}-{identity_digest(identity)[:8]}"
        folder = RunFolder.open(Path(config.run_dir or f"runs/{dataset.name}/{name}"), identity)
        chosen = select([dataset[i] for i in range(len(dataset))], config.limit)
        done = folder.done()
        todo = [pair for pair in chosen if pair.key not in done]
        processes = len(todo) >= MANY if config.processes is None else bool(config.processes)
        processes = processes and device.type == "cpu"
        cores = os.cpu_count() or 1
        workers = config.workers or (1 if device.type != "cpu" else min(cores, MOST_PROCESSES) if processes else cores)
        bar = progress.add_task(pipeline_name, total=len(chosen), completed=len(chosen) - len(todo))
        build = functools.partial(presets.build_pipeline, config, device) if processes and workers > 1 else None
        for count in evaluate_pairs(
            pipeline, todo, seed=config.seed, batch=config.batch, workers=workers, store=folder.append, build=build
        ):
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
    console.print(f"[dim]{folder.path}: pairs/, summary.json, summary.md, recall.png[/dim]")
    if isinstance(pipeline.extractor, CachedFeatures):
        console.print(f"[dim]{pipeline.extractor.report()}[/dim]")
    if chosen and summary[ALL]["failures"] == len(chosen):
        reason = next(iter(table["reason"].to_pylist()))
        raise ValueError(
            f"every pair failed, the first because: {reason}. Once that is mended, delete {folder.path} to run again"
        )
    return folder.path


def _load(config: DictConfig, progress: Progress) -> PairDataset:
    """The data set of a config; the embedded one is drawn on first use, which the progress bar shows."""
    options = plain(config)
    if "_target_" in options:  # somebody's own data set
        dataset: PairDataset = presets.instantiate(options, "dataset")
        return dataset
    return data.load(**options, progress=reporter(progress, "drawing scenes"))


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="eval")
def main(config: DictConfig) -> None:
    """The command."""
    with exits_with_message("interrupted; the same command continues the run"):
        run(config, str(HydraConfig.get().runtime.choices["pipeline"]))


if __name__ == "__main__":
    main()
