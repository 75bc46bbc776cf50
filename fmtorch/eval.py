"""`python -m fmtorch.eval pipeline=sift_ratio`: run a pipeline over a data set of image pairs and evaluate it."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from fmtorch import __version__, data, presets
from fmtorch.data import PairDataset
from fmtorch.evaluation.plots import plot_recall_curves
from fmtorch.evaluation.run import evaluate_pairs, select
from fmtorch.evaluation.summary import summarize, summary_markdown, summary_table
from fmtorch.pipeline import Pipeline
from fmtorch.resources import conf_dir
from fmtorch.storage import RunFolder, identity_digest

STAGE_GROUPS = ("features", "matcher", "pruner", "estimator")
console = Console()


def resolve_device(name: str) -> torch.device:
    """The torch device of a config: `auto` takes a GPU where there is one. Raises ValueError where it is not there."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device={name}: this installation of torch sees no CUDA device; use device=cpu")
    return device


def build_pipeline(config: DictConfig, device: torch.device) -> Pipeline:
    """The pipeline that the groups of a config describe."""
    pruners = {str(k): presets.instantiate(v, f"pruner={k}") for k, v in (config.pruner or {}).items()}
    return Pipeline(
        presets.instantiate(config.features, "features"),
        presets.instantiate(config.matcher, "matcher"),
        pruners,
        presets.instantiate(config.estimator, "estimator"),
        device=device,
    )


def run(config: DictConfig, pipeline_name: str) -> Path:
    """Evaluate one composed config and return the run folder."""
    device = resolve_device(config.device)
    with _progress() as progress:
        dataset = _load(config.dataset, progress)
        stages = {group: _plain(config[group]) for group in STAGE_GROUPS}
        identity = {
            "pipeline": pipeline_name, **stages, "seed": config.seed, "version": __version__,
            "dataset": {**{k: v for k, v in _plain(config.dataset).items() if k != "root"}, "digest": dataset.digest},
        }  # fmt: skip
        name = f"{pipeline_name}-{identity_digest(identity)[:8]}"
        folder = RunFolder.open(Path(config.run_dir or f"runs/{dataset.name}/{name}"), identity)
        pipeline = build_pipeline(config, device)
        chosen = select([dataset[i] for i in range(len(dataset))], config.limit)
        done = folder.done()
        todo = [pair for pair in chosen if pair.key not in done]
        workers = config.workers or (1 if device.type != "cpu" else os.cpu_count() or 1)
        bar = progress.add_task(pipeline_name, total=len(chosen), completed=len(chosen) - len(todo))
        for count in evaluate_pairs(
            pipeline, todo, seed=config.seed, batch=config.batch, workers=workers, store=folder.append
        ):
            progress.advance(bar, count)
    keys = {pair.key for pair in chosen}
    table = folder.read(keys)
    summary = summarize(table)
    folder.write_summary(summary, summary_markdown(summary, title=f"{pipeline_name} on {dataset.name}"))
    plot_recall_curves({pipeline_name: table}, folder.path / "recall.png")
    console.print(summary_table(summary, title=f"{pipeline_name} on {dataset.name}"))
    console.print(f"[dim]{folder.path}: pairs/, summary.json, summary.md, recall.png[/dim]")
    return folder.path


def _load(config: DictConfig, progress: Progress) -> PairDataset:
    """The data set of a config; the embedded one is drawn on first use, which the progress bar shows."""
    bar: list[TaskID] = []

    def drawn(done: int, total: int) -> None:
        if not bar:
            bar.append(progress.add_task("drawing scenes", total=total))
        progress.update(bar[0], completed=done, total=total)

    options = _plain(config)
    if "_target_" in options:  # somebody's own data set
        dataset: PairDataset = presets.instantiate(options, "dataset")
        return dataset
    return data.load(**options, progress=drawn)


def _plain(config: Any) -> dict[str, Any]:
    container = OmegaConf.to_container(config, resolve=True) if config is not None else {}
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def _progress() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=Console(stderr=True))


@hydra.main(version_base=None, config_path=str(conf_dir()), config_name="eval")
def main(config: DictConfig) -> None:
    """The command."""
    try:
        run(config, str(HydraConfig.get().runtime.choices["pipeline"]))
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command continues the run")
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
