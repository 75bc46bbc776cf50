"""What a pruner is trained and validated on: the labelled matches that a config asks for."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
from collections import Counter
from typing import Any

from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import data, presets
from fmtorch.core.terminal import reporter
from fmtorch.data import ImagePair, PairDataset
from fmtorch.data.construction import ENOUGH
from fmtorch.data.pairs import subset
from fmtorch.evaluation.run import select
from fmtorch.pipeline.labelled import Augmentation, LabelledMatches, MatchedPairs, StoredMatches
from fmtorch.pipeline.labelled.stored import last_scenes
from fmtorch.pipeline.labelled.transforms import keep_ratio
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.presets import plain
from fmtorch.presets.executors import execution_of
from fmtorch.runs.feature_cache import cached
from fmtorch.scenes import RenderedPairs
from fmtorch.training.photographs import Photograph, list_photographs
from fmtorch.training.planes import PlanePairs, PlaneViews


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """Labelled matches to train on, and to validate on with their pairs; their digest; what a card says of them."""

    training: StoredMatches
    validation: list[tuple[ImagePair, LabelledMatches]]
    digest: str
    description: dict[str, str]


def labelled_matches(config: DictConfig, progress: Progress) -> Matches:
    """The matches of the config's data set, split by scenes, and of its further validation sets.

    Raises ValueError where there is nothing to train on or to validate on.
    """
    photographs, given = list[Photograph](), config.photographs
    if config.planes.photographs is not None:
        photographs = list_photographs(config.planes.photographs, given.sources, given.excluded)
    views = _views(config)
    dataset = _dataset(config, progress)
    training, held_out = _split(dataset, config.validation.scenes)
    chosen = _limited(dataset, training, config.limit)
    if not chosen:
        raise ValueError(f"no pairs to train on: {config.validation.scenes} scenes of each family are for validation")
    front = _front(config)
    matched = _matched(config, dataset, chosen, front, progress, "matches to train on")
    digests, validation = [matched.folder.name], []
    sets: list[tuple[PairDataset, list[int], str]] = [(dataset, held_out, "matches to validate on")]
    for root in config.validation.roots:
        real = data.load("fmbench", root=root)
        sets.append((real, list(range(len(real))), f"matches of {root}"))
    for source, indices, title in sets:
        selected = _limited(source, indices, config.validation.pairs)
        if not selected:
            continue
        stored = _matched(config, source, selected, front, progress, title)
        digests.append(stored.folder.name)
        pairs = {source[i].key: source[i] for i in selected}
        for i, about in enumerate(stored.pairs):
            matches = keep_ratio(stored.stored(i), config.validation.ratio).compact()
            validation.append((pairs[about["key"]], matches))
    if not validation:
        raise ValueError("no pairs to validate on: give validation.scenes or validation.roots")
    families = Counter(pair.family for pair, _ in validation)
    scenes = {about["scene"] for about in matched.pairs}
    description = {
        "training": f"{len(matched)} pairs of {len(scenes)} scenes of {dataset.name}",
        "validation": ", ".join(f"{count} pairs of {family}" for family, count in families.items())
        + f" (of {dataset.name} the last {config.validation.scenes} scenes of each family, which share photographs "
        "with the training scenes)",
    }
    if photographs:
        planes = _planes(config, photographs, views, front, progress)
        digests.append(planes.folder.name)
        seen = {about["scene"] for about in planes.pairs}
        description["training"] += f" and {len(planes)} pairs of {len(seen)} photographs seen as planes"
        matched = matched.joined(planes)
    augmented = matched.augmented(Augmentation(**_ranges(plain(config.augmentation))), config.seed)
    return Matches(augmented, validation, hashlib.sha256(" ".join(digests).encode()).hexdigest(), description)


def _dataset(config: DictConfig, progress: Progress) -> PairDataset:
    """The data set to train on; of the embedded one always the training side."""
    options = plain(config.dataset)
    if presets.target_of(options, "dataset") is RenderedPairs:
        options["split"] = "train"
    return data.build(options, reporter(progress, "drawing scenes"))


def _views(config: DictConfig) -> PlaneViews:
    options = _ranges(plain(config.planes))
    return PlaneViews(**{key: value for key, value in options.items() if key not in ("photographs", "seed")})


def _planes(
    config: DictConfig, photographs: list[Photograph], views: PlaneViews, front: Pipeline, progress: Progress
) -> StoredMatches:
    """The matches of views of photographs, of pairs with more inliers than the paper asks of a pair."""
    pairs = PlanePairs(
        photographs, views, config.planes.seed,
        workers=config.workers or os.cpu_count() or 1, progress=reporter(progress, "views of photographs"),
    )  # fmt: skip
    matched = _matched(config, pairs, list(range(len(pairs))), front, progress, "matches of photographs")
    return matched.select(i for i, about in enumerate(matched.pairs) if about["inliers"] > ENOUGH)


def _split(dataset: PairDataset, last: int) -> tuple[list[int], list[int]]:
    """Indices of the pairs to train on, and of those in the last scenes of each family."""
    pairs = [dataset[i] for i in range(len(dataset))]
    held = last_scenes(((pair.family, pair.scene) for pair in pairs), last)
    sides: tuple[list[int], list[int]] = ([], [])
    for i, pair in enumerate(pairs):
        sides[(pair.family, pair.scene) in held].append(i)
    return sides


def _limited(dataset: PairDataset, indices: list[int], limit: int | None) -> list[int]:
    """At most `limit` pairs of each family, chosen by their keys."""
    index = {dataset[i].key: i for i in indices}
    return sorted(index[pair.key] for pair in select([dataset[i] for i in indices], limit))


def _front(config: DictConfig) -> Pipeline:
    """Features, matcher and the pruners before the trained one."""
    extractor = cached(presets.instantiate(plain(config.features), "features"), config.cache, config.cache_limit)
    before = {str(name): presets.build("pruner", str(name)) for name in config.before}
    matcher: Any = presets.instantiate(plain(config.matcher), "matcher")
    return Pipeline(extractor, matcher, before, _no_estimator)


def _no_estimator(c: Any, seed: int = 0) -> Any:
    raise NotImplementedError("the stages before estimation only")


def _matched(
    config: DictConfig, dataset: PairDataset, indices: list[int], front: Pipeline, progress: Progress, title: str
) -> StoredMatches:
    selected = subset(dataset, indices) if len(indices) < len(dataset) else dataset
    execution = execution_of(config, config.workers).decided(False)
    return MatchedPairs(
        selected,
        front,
        execution=execution,
        build=functools.partial(_front, config),
        progress=reporter(progress, title),
    )


def _ranges(options: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}
