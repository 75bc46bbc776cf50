"""What defines the results of a run: the pipeline and all that its stages are made of, the data set, the seed.

Not what changes speed or extent alone: limit, device, batch, workers, processes, cache.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from fmtorch import presets
from fmtorch.jit import kernel
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets import plain
from fmtorch.runs.feature_cache import CachedFeatures
from fmtorch.runs.fingerprint import code_digest, file_digest, fmtorch_version, learned, libraries

PLACES = ("root", "file", "truth", "images")
"""Options of data sets that say where things lie; the digest says what they are."""


def run_identity(
    config: DictConfig,
    pipeline_name: str,
    pipeline: Pipeline,
    dataset_digest: str,
    cameras: str | None = None,
    signed: bool = False,
) -> dict[str, Any]:
    """The identity of a run, as plain values.

    Args:
        config: a composed config: stages, data set, seed.
        pipeline_name: the preset that it began with.
        pipeline: what was built of the config.
        dataset_digest: of the contents of the data set.
        cameras: what the estimator is given of the cameras; None: nothing.
        signed: whether the sign of a translation counts.

    Returns:
        `pipeline`, each stage's config (pruners as a list), `seed`; `version` of fmtorch, in a checkout its commit;
        `libraries`: their versions; `kernels`: by which numba, or off; `learned`: digests of each stage's learned
        files; `code`: digests of the sources of parts of the user's own; `dataset`: its config, without where it lies,
        and its digest; `cameras`, where they are given; `pose`, where translations are signed.
    """
    stages = presets.stages(config)
    dataset = {
        **{key: value for key, value in plain(config.dataset).items() if key not in PLACES},
        "digest": dataset_digest,
    }
    return {
        "pipeline": pipeline_name, **stages, "seed": config.seed, "version": fmtorch_version(),
        "libraries": libraries(presets.peer_packages(stages)), "kernels": kernel.identity(),
        "learned": _learned(stages, pipeline),
        "code": _code({"stages": stages, "dataset": dataset}), "dataset": dataset,
        **({} if cameras is None else {"cameras": cameras}), **({"pose": {"signed": True}} if signed else {}),
    }  # fmt: skip


def _learned(stages: Mapping[str, Any], pipeline: Pipeline) -> dict[str, list[str]]:
    """Digests of the learned files and networks of each stage that has some."""
    extractor = pipeline.extractor
    parts: dict[str, list[object]] = {
        "features": [extractor.extractor if isinstance(extractor, CachedFeatures) else extractor],
        "matcher": [pipeline.matcher], "estimator": [pipeline.estimator],
        "pruner": [p for pruners in (pipeline.pruners, *pipeline.families.values()) for p in pruners.values()],
    }  # fmt: skip
    digests = {
        group: {*(digest for part in parts[group] for digest in learned(part)), *_files(stages.get(group))}
        for group in presets.STAGES
    }
    return {group: sorted(digests_of_group) for group, digests_of_group in digests.items() if digests_of_group}


def _files(config: object, option: str = "") -> Iterator[str]:
    """Digests of the files that options name: a part that does not say what defines it may well read them."""
    if isinstance(config, Mapping):
        for key, value in config.items():
            yield from _files(value, str(key))
    elif isinstance(config, list):
        for value in config:
            yield from _files(value, option)
    elif isinstance(config, str) and option != "_target_" and Path(config).suffix:
        path = Path(config).expanduser()
        with contextlib.suppress(OSError, ValueError):
            if path.is_file():
                yield file_digest(path)


def _code(config: object) -> dict[str, str]:
    """Digests of the sources that define the parts of the user's own, by the names of these."""
    digests = {}
    for target, module in presets.own_modules(config).items():
        try:
            digests[target] = code_digest(module)
        except (TypeError, KeyError, OSError):
            digests[target] = "in no file"
    return digests
