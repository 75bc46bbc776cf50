"""`MatchedPairs`: a data set of image pairs seen through a pipeline's first stages, with labels, kept on disk."""

import functools
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from omegaconf import DictConfig

from fmtorch import presets
from fmtorch.core import Correspondences, files
from fmtorch.data.pairs import DepthDataset, ImagePair, PairDataset
from fmtorch.io import oanet
from fmtorch.jobs import Execution, Factory, Local, Source, TaskRunner, WorkerPool, use_one_thread
from fmtorch.pipeline.pipeline import Outcome, Pipeline, load_pipeline
from fmtorch.runs import CachedFeatures, cached, identity_digest
from fmtorch.runs.fingerprint import configuration, environment
from fmtorch.training import labelled
from fmtorch.training.stored_matches import ARRAYS, FORMAT, Shard, ShardError, StoredMatches, write_shard

MAX_MATCHES = 4000  # kept of a pair, the least ambiguous
Progress = Callable[[int, int], None]  # called with (pairs done, pairs in all)
SHARD = 32  # pairs in a file, all of one scene: what an interruption can cost; a change is one of FORMAT
PRELOADED = (__name__,)  # by the process that workers are forked of
_IMAGES = 64  # whose features each worker may need again


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
        augmentation, seed: as of `StoredMatches`.
        execution: other workers than these threads. build: makes the pipeline in other processes, where it is given as
            an object; pickled, as is the data set.
        labels: pixels: by depth or the epipolar lines; geodesic: OANet's, for which the cameras must be known.

    Raises ValueError for an unknown pipeline, for one whose stages do not say what defines their results, for an empty
    data set, and where every pair fails.

    Example:
        >>> from fmtorch.data import load
        >>> from fmtorch.training import Augmentation, MatchedPairs
        >>> rendered = load("rendered", split="train", size="full")  # doctest: +SKIP
        >>> matches = MatchedPairs(
        ...     rendered, "sift_ratio", overrides=["pruner=[one_to_one]"], augmentation=Augmentation()
        ... )  # doctest: +SKIP
    """

    def __init__(
        self, dataset: PairDataset, pipeline: Pipeline | str, *, overrides: Sequence[str] = (),
        root: str | Path | None = None, workers: int | None = None, progress: Progress | None = None,
        augmentation: labelled.Augmentation | None = None, seed: int = 0,
        execution: Execution | None = None, build: Callable[[], Pipeline] | None = None,
        labels: labelled.Rule = "pixels",
    ) -> None:  # fmt: skip
        if not len(dataset):
            raise ValueError(f"the data set {dataset.name} has no pairs")
        if (model := getattr(dataset, "model", "fundamental")) != "fundamental":
            what = f"the data set {dataset.name} has {model} matrices"
            raise ValueError(f"{what}; matches are labelled by fundamental ones")
        stages, execution = pipeline, execution or Execution("threads", workers)
        if isinstance(stages, str):
            build = build or functools.partial(load_pipeline, stages, overrides=tuple(overrides))
            stages = load_pipeline(stages, overrides=overrides)
        elif overrides:
            raise ValueError("overrides change a pipeline that is given by name; this one is given as an object")
        if build is None and not execution.shared:
            raise ValueError("other processes need to make the pipeline: give its name, or `build`")
        home = Path(root).expanduser() if root is not None else files.cache_dir() / "matched"
        identity = _identity(dataset, stages, labels)
        folder = home / f"{dataset.name}-{identity_digest(identity)[:16]}"
        files.claim(folder / "about.json", identity, "matches", "delete the folder", alone=False)
        pairs = [dataset[i] for i in range(len(dataset))]
        shards = [[pairs[i] for i in members] for members in partition(pairs)]
        jobs = [Job(folder / f"shard-{number:05d}.arrow", members) for number, members in enumerate(shards)]
        missing = [job for job in jobs if not _sound(job.path, len(job.pairs))]
        done, total = len(pairs) - sum(len(job.pairs) for job in missing), len(pairs)
        report = progress or (lambda done, total: None)
        report(done, total)
        for count in compute_shards(dataset, stages, build, missing, labels, execution):
            done += count
            report(done, total)
        super().__init__(folder, augmentation=augmentation, seed=seed)


def _identity(dataset: PairDataset, stages: Pipeline, rule: labelled.Rule) -> dict[str, Any]:
    extractor: Any = stages.extractor
    extractor = extractor.extractor if isinstance(extractor, CachedFeatures) else extractor
    families = [stages.families] if stages.families else []
    try:
        parts = configuration([extractor, stages.matcher, stages.pruners, *families])
    except TypeError as error:
        raise ValueError(f"the matches of this pipeline cannot be kept: {error}") from error
    rules: list[Any] = ["depth" if isinstance(dataset, DepthDataset) else "lines"]
    rules += [labelled.INLIER_PX, labelled.OUTLIER_PX, labelled.EDGE_PX]
    rules = rules if rule == "pixels" else [rule, oanet.GEODESIC]
    return {
        "format": FORMAT, "dataset": [dataset.name, dataset.digest], "most": MAX_MATCHES,
        "labels": [labelled.VERSION, *rules],
        "stages": parts, "environment": environment(),
    }  # fmt: skip


def front(config: DictConfig) -> Pipeline:
    """The stages before estimation that a config names: features, matcher, and the pruners `before`, if any."""
    features = presets.instantiate(presets.plain(config.features), "features")
    extractor = cached(features, config.get("cache"), config.get("cache_limit"))
    before = {str(name): presets.build("pruner", str(name)) for name in config.get("before") or ()}
    matcher: Any = presets.instantiate(presets.plain(config.matcher), "matcher")
    return Pipeline(extractor, matcher, before, _no_estimator)


def _no_estimator(c: Any, seed: int = 0) -> Any:
    raise NotImplementedError("the stages before estimation only")


def _sound(path: Path, pairs: int) -> bool:
    if not path.exists():
        return False
    try:
        count = len(Shard(path, verify=True))
        if count == pairs:
            return True
        problem = f"{path} has {count} pairs instead of {pairs}"
    except ShardError as error:
        problem = str(error)
    warnings.warn(f"{problem}; it is computed anew", stacklevel=3)
    return False


def partition(pairs: Sequence[ImagePair]) -> list[list[int]]:
    """Indices of the pairs of each shard: at most `SHARD` of one scene, those that share images together."""
    names = [(p.family, p.scene, p.image0.identity, p.image1.identity) for p in pairs]
    order = sorted(range(len(pairs)), key=lambda i: (names[i], i))
    shards: list[list[int]] = []
    for i in order:
        if not shards or len(shards[-1]) == SHARD or names[shards[-1][-1]][:2] != names[i][:2]:
            shards.append([])
        shards[-1].append(i)
    return shards


class Matching(NamedTuple):
    """What pairs are matched and labelled by.
    dataset: where they are from. pipeline: its stages before estimation are run. labels: what they go by."""

    dataset: PairDataset
    pipeline: Pipeline
    labels: labelled.Rule


class Job(NamedTuple):
    """A shard to compute: its file and its pairs."""

    path: Path
    pairs: list[ImagePair]


def matching(
    dataset: PairDataset, build: Callable[[], Pipeline], labels: labelled.Rule, images: int = _IMAGES
) -> Matching:
    """The matching by the stages of a pipeline that is built, with the features of so many images kept."""
    stages = build()
    parts = stages.extractor, stages.matcher, stages.pruners, stages.estimator
    pipeline = Pipeline(*parts, device=stages.device, memory=images, families=stages.families)
    return Matching(dataset, pipeline, labels)


def compute_shards(
    dataset: PairDataset, stages: Pipeline, build: Callable[[], Pipeline] | None, jobs: Sequence[Job],
    labels: labelled.Rule, execution: Execution,
) -> Iterator[int]:  # fmt: skip
    """Write each job's shard; yields the number of its pairs when it is written.
    stages: the pipeline whose stages before estimation are run by threads; build: makes it in other processes, pickled.
    execution: by which workers, each with one thread of the libraries."""
    pool = WorkerPool(execution, PRELOADED)
    source: Source[Matching]
    if execution.shared:
        source = Local(matching(dataset, lambda: stages, labels, _IMAGES * pool.size))
    else:
        assert build is not None
        source = Factory(functools.partial(matching, dataset, build, labels))
    runner = TaskRunner(pool, source, matched_rows, lambda job, rows: write_shard(job.path, rows))
    threads = torch.get_num_threads(), cv2.getNumThreads()
    use_one_thread()
    try:
        with pool:
            for job in runner.each(jobs):
                yield len(job.pairs)
    finally:  # interrupted: what is under way is finished and kept
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])


def matched_rows(how: Matching, job: Job) -> list[dict[str, Any]]:
    """The rows of a shard."""
    return [_row(how, how.pipeline.correspondences([pair])[0]) for pair in job.pairs]


def _row(how: Matching, outcome: Outcome) -> dict[str, Any]:
    """A pair as a row of a shard; a pair that fails has a reason and no matches."""
    pair, c = outcome.pair, outcome.correspondences
    row: dict[str, Any] = {
        "key": pair.key, "identity": pair.identity, "family": pair.family, "scene": pair.scene,
        "reason": outcome.reason, "matches": 0, "inliers": 0, "outliers": 0,
    }  # fmt: skip
    if c is None:
        return row
    c = _best(c.detach().to("cpu").compact())
    if not len(c.x0[0]):
        return {**row, "reason": "no matches are left"}
    x0, x1 = (x[0].to(torch.float64).numpy() for x in (c.x0.to(torch.float32), c.x1.to(torch.float32)))
    labels = labelled.label(how.dataset, pair, x0, x1, how.labels)
    norm = np.linalg.norm(pair.F) or 1.0  # zero where the pair determines none
    row |= {
        "matches": len(labels), "inliers": int((labels == 1).sum()), "outliers": int((labels == 0).sum()),
        "label": labels, "F": (pair.F / norm).ravel(),
    }  # fmt: skip
    tensors = ((name, getattr(c, name), kind) for name, (kind, _) in ARRAYS.items() if name not in row)
    return row | {name: x.to(getattr(torch, kind)).reshape(-1).numpy() for name, x, kind in tensors if x is not None}


def _best(c: Correspondences) -> Correspondences:
    """The `MAX_MATCHES` least ambiguous matches of a single pair, in their order; the first if nothing ranks them."""
    n = c.x0.shape[1]
    if n <= MAX_MATCHES:
        return c
    rank = torch.arange(n) if c.ambiguity is None else torch.argsort(c.ambiguity[0], stable=True)
    kept = torch.zeros_like(c.mask)
    kept[0, rank[:MAX_MATCHES]] = True
    return c.keep(kept).compact()
