"""`MatchedPairs`: a data set of image pairs seen through a pipeline's first stages, with labels."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fmtorch.core.files import cache_dir
from fmtorch.core.settings import claim
from fmtorch.data.pairs import DepthDataset, PairDataset
from fmtorch.jobs.execution import Execution
from fmtorch.pipeline.build import load_pipeline
from fmtorch.pipeline.labelled import labels
from fmtorch.pipeline.labelled.augmentation import Augmentation
from fmtorch.pipeline.labelled.compute import Job, Progress, compute_shards, partition
from fmtorch.pipeline.labelled.shards import FORMAT, Shard, ShardError
from fmtorch.pipeline.labelled.stored import StoredMatches
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.runs.feature_cache import CachedFeatures
from fmtorch.runs.fingerprint import configuration, environment
from fmtorch.runs.run_folder import identity_digest

MAX_MATCHES = 4000  # matches kept of a pair


class MatchedPairs(StoredMatches):
    """Labelled matches of the pairs of any data set with ground truth; for torch's DataLoader with `collate`.

    Matches are computed once, by `workers` threads, and kept on disk; an interrupted computation goes on where it
    stopped, a damaged file is computed anew. The folder's name holds a digest of all that defines them: data set,
    stages before estimation, label rules, libraries. Pairs come ordered by family, scene and images. A pipeline without
    a ratio test leaves the threshold to the `augmentation`. Several processes may compute the same folder at once: each
    does all that is missing when it starts, and they agree.

    Args:
        dataset: image pairs with ground truth; labels are by depth where it is a `DepthDataset`.
        pipeline: a `Pipeline`, or the name of one of conf/pipeline. Its estimator is not used.
        overrides: changes of a named pipeline, as on the command line, e.g. ``["pruner=[one_to_one]"]``.
        root: the folder of such folders, by default ``matched`` in the cache folder.
        workers: threads, by default one a core. progress: called with (pairs done, pairs in all).
        most: matches kept of a pair, the best by quality.
        augmentation, seed: as of `StoredMatches`.
        execution: other workers than these threads. build: makes the pipeline in other processes, where it is given as
            an object; pickled, as is the data set.

    Raises ValueError for an unknown pipeline, for one whose stages do not say what defines their results, for an empty
    data set, for `most` below 1, and where every pair fails.

    Example:
        >>> from fmtorch.data import load
        >>> from fmtorch.pipeline.labelled import Augmentation, MatchedPairs
        >>> rendered = load("rendered", split="train", size="full")  # doctest: +SKIP
        >>> matches = MatchedPairs(
        ...     rendered, "sift_ratio", overrides=["pruner=[one_to_one]"], augmentation=Augmentation()
        ... )  # doctest: +SKIP
    """

    def __init__(
        self,
        dataset: PairDataset,
        pipeline: Pipeline | str,
        *,
        overrides: Sequence[str] = (),
        root: str | Path | None = None,
        workers: int | None = None,
        progress: Progress | None = None,
        most: int = MAX_MATCHES,
        augmentation: Augmentation | None = None,
        seed: int = 0,
        execution: Execution | None = None,
        build: Callable[[], Pipeline] | None = None,
    ) -> None:
        if most < 1:
            raise ValueError(f"most is {most}; at least 1 match of a pair must be kept")
        if not len(dataset):
            raise ValueError(f"the data set {dataset.name} has no pairs")
        if (model := getattr(dataset, "model", "fundamental")) != "fundamental":
            raise ValueError(
                f"the data set {dataset.name} has {model} matrices; matches are labelled by fundamental ones"
            )
        stages = _pipeline(pipeline, overrides)
        home = Path(root).expanduser() if root is not None else cache_dir() / "matched"
        identity = _identity(dataset, stages, most)
        folder = home / f"{dataset.name}-{identity_digest(identity)[:16]}"
        claim(folder / "about.json", identity, "matches", "delete the folder", alone=False)
        pairs = [dataset[i] for i in range(len(dataset))]
        shards = [[pairs[i] for i in members] for members in partition(pairs)]
        jobs = [Job(folder / f"shard-{number:05d}.arrow", members) for number, members in enumerate(shards)]
        missing = [job for job in jobs if not _sound(job.path, len(job.pairs))]
        done, total = len(pairs) - sum(len(job.pairs) for job in missing), len(pairs)
        report = progress or (lambda done, total: None)
        report(done, total)
        execution = execution or Execution("threads", workers)
        build = build or (_build(pipeline, overrides) if isinstance(pipeline, str) else None)
        if execution.shared:
            build = functools.partial(_pipeline, stages, ())
        elif build is None:
            raise ValueError("other processes need to make the pipeline: give its name, or `build`")
        for count in compute_shards(dataset, build, missing, most=most, execution=execution):
            done += count
            report(done, total)
        super().__init__(folder, augmentation=augmentation, seed=seed)


def _identity(dataset: PairDataset, stages: Pipeline, most: int) -> dict[str, Any]:
    """What defines the matches and their labels, as plain values."""
    extractor = stages.extractor
    if isinstance(extractor, CachedFeatures):
        extractor = extractor.extractor
    try:
        parts = configuration(
            [extractor, stages.matcher, stages.pruners, *([stages.families] if stages.families else [])]
        )
    except TypeError as error:
        raise ValueError(f"the matches of this pipeline cannot be kept: {error}") from error
    rules = [labels.INLIER_PX, labels.OUTLIER_PX, labels.EDGE_PX]
    return {
        "format": FORMAT, "dataset": [dataset.name, dataset.digest], "most": most,
        "labels": [labels.VERSION, "depth" if isinstance(dataset, DepthDataset) else "lines", *rules],
        "stages": parts, "environment": environment(),
    }  # fmt: skip


def _build(name: str, overrides: Sequence[str]) -> Callable[[], Pipeline]:
    return functools.partial(_pipeline, name, tuple(overrides))


def _pipeline(pipeline: Pipeline | str, overrides: Sequence[str]) -> Pipeline:
    if isinstance(pipeline, str):
        built: Pipeline = load_pipeline(pipeline, overrides=overrides)
        return built
    if overrides:
        raise ValueError("overrides change a pipeline that is given by name; this one is given as an object")
    return pipeline


def _sound(path: Path, pairs: int) -> bool:
    """Whether a file is there and whole, with so many pairs; of a damaged one a warning tells."""
    if not path.exists():
        return False
    try:
        shard = Shard(path, verify=True)
        if len(shard) != pairs:
            raise ShardError(f"{path} has {len(shard)} pairs instead of {pairs}")
    except ShardError as error:
        warnings.warn(f"{error}; it is computed anew", stacklevel=3)
        return False
    return True
