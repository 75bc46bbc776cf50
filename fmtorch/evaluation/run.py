"""The loop that makes a run: batches of pairs through a pipeline on worker threads, rows stored as they come."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

import torch

from fmtorch.data.pairs import ImagePair
from fmtorch.evaluation.rows import evaluate
from fmtorch.pipeline import Pipeline
from fmtorch.storage import PairRow


def select(pairs: Sequence[ImagePair], limit: int | None) -> list[ImagePair]:
    """The pairs, ordered so that those that share images follow one another; with a limit, that many of each family.

    The limited choice is by the pairs' keys: spread over the scenes, and a smaller one is part of a larger one.
    """
    chosen = list(pairs)
    if limit is not None:
        families: dict[str, list[ImagePair]] = {}
        for pair in sorted(chosen, key=lambda pair: pair.key):
            families.setdefault(pair.family, []).append(pair)
        chosen = [pair for family in families.values() for pair in family[:limit]]
    return sorted(chosen, key=lambda pair: (pair.family, pair.scene, pair.image0.identity, pair.image1.identity))


def evaluate_pairs(
    pipeline: Pipeline,
    pairs: Sequence[ImagePair],
    *,
    seed: int,
    batch: int,
    workers: int,
    store: Callable[[list[PairRow]], None],
) -> Iterator[int]:
    """Run and evaluate the pairs, hand each batch's rows to `store`, and yield how many pairs it held.

    One thread of torch's own per worker: small operations on several contended threads collapse. Results do not
    depend on `batch` or `workers`.
    """
    batches = [list(pairs[i : i + batch]) for i in range(0, len(pairs), batch)]

    def work(some: list[ImagePair]) -> list[PairRow]:
        return evaluate(pipeline.run(some, seed), seed)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    executor = ThreadPoolExecutor(workers)
    waiting: set[Future[list[PairRow]]] = set()
    try:
        todo = iter(batches)
        while True:
            for some in todo:
                waiting.add(executor.submit(work, some))
                if len(waiting) > workers:
                    break
            if not waiting:
                return
            finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in finished:
                rows = future.result()
                store(rows)
                yield len(rows)
    finally:  # interrupted: what is under way is finished and kept
        executor.shutdown(wait=True, cancel_futures=True)
        for future in waiting:
            if not future.cancelled() and future.exception() is None:
                store(future.result())
        torch.set_num_threads(before)
