"""Labelled matches of a data set's pairs, a shard at a time, by several workers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from fmtorch.core.types import Correspondences
from fmtorch.data.pairs import ImagePair, PairDataset
from fmtorch.jobs.execution import Execution
from fmtorch.jobs.pool import WorkerPool
from fmtorch.jobs.runner import Factory, Local, Source, TaskRunner
from fmtorch.jobs.threads import use_one_thread
from fmtorch.pipeline.labelled.labels import label
from fmtorch.pipeline.labelled.shards import write_shard
from fmtorch.pipeline.pipeline import Outcome, Pipeline

Progress = Callable[[int, int], None]  # called with (pairs done, pairs in all)
SHARD = 32  # pairs in a file, all of one scene: what an interruption can cost; a change is one of shards.FORMAT
PRELOADED = ("fmtorch.pipeline.labelled.compute",)  # by the process that workers are forked of
_IMAGES = 64  # whose features each worker may need again
_FLOATS = ("quality", "prior", "noise")
_FRAMES = ("lafs0", "lafs1")


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

    dataset: where they are from. pipeline: its stages before estimation are run. most: matches kept of a pair, the best
    by quality.
    """

    dataset: PairDataset
    pipeline: Pipeline
    most: int


class Job(NamedTuple):
    """A shard to compute: its file and its pairs."""

    path: Path
    pairs: list[ImagePair]


def matching(dataset: PairDataset, build: Callable[[], Pipeline], most: int, images: int) -> Matching:
    """The matching by a pipeline that `build` makes, with the features of so many images kept."""
    template = build()
    pipeline = Pipeline(
        template.extractor, template.matcher, template.pruners, template.estimator,
        device=template.device, memory=images, families=template.families,
    )  # fmt: skip
    return Matching(dataset, pipeline, most)


def compute_shards(
    dataset: PairDataset, build: Callable[[], Pipeline], jobs: Sequence[Job], *, most: int, execution: Execution
) -> Iterator[int]:
    """Write each job's shard; yields the number of its pairs when it is written.

    Args:
        dataset: where the pairs are from. build: makes the pipeline whose stages before estimation are run; pickled
        where workers are no threads. jobs: files and their pairs. most: matches kept of a pair, the best by quality.
        execution: by which workers, each with one thread of the libraries.
    """
    pool = WorkerPool(execution, PRELOADED)
    images = _IMAGES * pool.size if execution.shared else _IMAGES
    make = functools.partial(matching, dataset, build, most, images)
    source: Source[Matching] = Local(make()) if execution.shared else Factory(make)
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
    return [_row(how.dataset, how.pipeline.match([pair])[0], how.most) for pair in job.pairs]


def _row(dataset: PairDataset, outcome: Outcome, most: int) -> dict[str, Any]:
    """A pair as a row of a shard; a pair that fails has a reason and no matches."""
    pair, c = outcome.pair, outcome.correspondences
    row: dict[str, Any] = {
        "key": pair.key, "identity": pair.identity, "family": pair.family, "scene": pair.scene,
        "reason": outcome.reason, "matches": 0, "inliers": 0, "outliers": 0,
    }  # fmt: skip
    if c is None:
        return row
    c = _best(c.detach().to("cpu").compact(), most)
    if not len(c.x0[0]):
        return {**row, "reason": "no matches are left"}
    x0, x1 = (x[0].to(torch.float64).numpy() for x in (c.x0.to(torch.float32), c.x1.to(torch.float32)))
    labels = label(dataset, pair, x0, x1)
    norm = np.linalg.norm(pair.F) or 1.0  # zero where the pair determines none
    row |= {
        "matches": len(labels), "inliers": int((labels == 1).sum()), "outliers": int((labels == 0).sum()),
        "label": labels, "F": (pair.F / norm).ravel(),
    }  # fmt: skip
    kinds = {
        **dict.fromkeys(("x0", "x1", *_FLOATS, *_FRAMES), torch.float32), "mutual": torch.uint8,
        **dict.fromkeys(("K0", "K1"), torch.float64), **dict.fromkeys(("size0", "size1"), torch.int64),
    }  # fmt: skip
    return row | {n: _flat(getattr(c, n), kind) for n, kind in kinds.items() if getattr(c, n) is not None}


def _best(c: Correspondences, most: int) -> Correspondences:
    """The `most` matches of the lowest quality of a single pair, in their order (the first ones without a quality)."""
    n = c.x0.shape[1]
    if n <= most:
        return c
    rank = torch.arange(n) if c.quality is None else torch.argsort(c.quality[0], stable=True)
    kept = torch.zeros_like(c.mask)
    kept[0, rank[:most]] = True
    return c.keep(kept).compact()


def _flat(value: torch.Tensor, kind: torch.dtype) -> Any:
    return value.to(kind).reshape(-1).numpy()
