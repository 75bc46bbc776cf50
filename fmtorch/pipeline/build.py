"""Pipelines of presets and of composed configs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.errors import HydraException
from omegaconf import DictConfig

from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets.composition import PIPELINES, compose, plain
from fmtorch.presets.files import available, unknown
from fmtorch.presets.objects import instantiate, open_files
from fmtorch.presets.pruners import build_pruners
from fmtorch.runs.feature_cache import cached


def build_pipeline(
    config: DictConfig, device: torch.device | str = "cpu", model: str | None = "fundamental"
) -> Pipeline:
    """The `Pipeline` that features (with cache), matcher, pruner and estimator of a composed config describe.

    model: what the estimator must give, "fundamental" or "homography"; None: either.
    """
    extractor = cached(instantiate(plain(config.features), "features"), config.cache, config.cache_limit)
    pruners, for_families = build_pruners(config)
    open_files([extractor, pruners, for_families], torch.device(device))  # a damaged one is no failure of each pair
    return Pipeline(
        extractor,
        instantiate(plain(config.matcher), "matcher"),
        pruners,
        instantiate(plain(config.estimator), "estimator"),
        device=device,
        families=for_families,
        model=model,
        debug=bool(config.get("debug")),
    )


def load_pipeline(
    name: str,
    device: torch.device | str = "cpu",
    overrides: Sequence[str] = (),
    config_dir: Path | str | None = None,
) -> Pipeline:
    """The `Pipeline` of ``conf/pipeline/<name>.yaml``, changed by `overrides` as on the command line.

    E.g. ``load_pipeline("sift_gms", overrides=["estimator=lmeds", "pruner.gms.with_scale=true"])``. Unlike the
    commands it keeps no features on disk unless asked to (``overrides=["cache=null"]``, or a folder).

    Args:
        name: a preset of conf/pipeline, or of `config_dir`.
        device: where features are described and everything behind them is computed.
        overrides: as words of a command.
        config_dir: a folder with presets of your own, as the commands take it by `--config-dir`.

    Raises:
        ValueError: for an unknown pipeline, naming those there are, for an override that does not apply, and where
            `config_dir` is no folder.
    """
    if config_dir is not None and not Path(config_dir).is_dir():
        raise ValueError(f"config_dir={config_dir} is no folder")
    if name not in available("pipeline", config_dir):
        raise ValueError(unknown("pipeline", name, config_dir))
    words = (f"pipeline={name}", "cache=off", *overrides)
    try:
        config = compose(PIPELINES, words, None if config_dir is None else Path(config_dir))
    except HydraException as error:
        raise ValueError(f"pipeline={name} with {', '.join(overrides)}: {error}") from error
    return build_pipeline(config, device)
