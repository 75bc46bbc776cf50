"""`python -m fmtorch.pairs dataset=kitti dataset.root=DIR output=KITTI`: a set of the pairs that can be matched."""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
import os
import signal
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Annotated, Any

import cv2
from hydra.core.utils import env_override
from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import data, presets
from fmtorch.commands.main import job, run_command
from fmtorch.core.executors import end_with_parent
from fmtorch.core.options import Within
from fmtorch.core.terminal import console, progress_bars
from fmtorch.data.construction import BLOCK, Construction, blocks
from fmtorch.data.scenes import ScenePairs
from fmtorch.presets import plain
from fmtorch.presets.fields import Count, Seed, path_fields, read_fields

MAX_PROCESSES = 8  # unless more are asked for
MIN_CANDIDATES_FOR_PROCESSES = 4 * BLOCK + 1  # below which processes are not worth their start
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclasses.dataclass(frozen=True)
class Fields:
    """What the command takes beside the data set; ``conf/pairs.yaml`` says what each is."""

    output: Path | None = None
    count: Count | None = 1000
    seed: Seed = 0
    workers: Count | None = None
    quality: Annotated[int, Within(1, 100)] = 95


def run(config: DictConfig) -> Path:
    """Make the set that a composed config describes and return its folder.

    Raises ValueError, before anything is computed or written, where an option is not what it may be.
    """
    fields = read_fields(Fields, config)
    if fields.output is None:
        raise ValueError("output is missing; it names the folder of the set that is made: output=KITTI")
    dataset = _load(config.dataset)
    construction = Construction(dataset, fields.output, fields.count, fields.seed, fields.quality)
    construction.begin()
    if construction.complete:
        console.print(
            f"{construction.folder} is complete: dataset=fmbench dataset.root={construction.folder}", highlight=False
        )
        return construction.folder
    many = dataset.candidates >= MIN_CANDIDATES_FOR_PROCESSES
    workers = fields.workers or (min(os.cpu_count() or 1, MAX_PROCESSES) if many else 1)
    start = time.monotonic()
    with progress_bars() as progress, _Team(construction, workers) as team:
        kept, judged, problems = _select(construction, team, progress)
        images = construction.used(kept)
        bar = progress.add_task("writing images", total=len(images))
        for _ in team.each("write_image", images):
            progress.advance(bar)
    summary = {"candidates": dataset.candidates, "judged": judged, "kept": len(kept), "images": len(images)}
    if not kept:
        raise ValueError(
            f"none of {judged} candidates passes the rule{_first(problems)}; {construction.folder} was not completed"
        )
    construction.finish(kept, summary)
    _tell(construction, summary, problems, time.monotonic() - start)
    return construction.folder


def _load(config: DictConfig) -> ScenePairs:
    """The data set of a config, all of whose candidates are asked for."""
    presets.expect_dataset(config)
    options = plain(config)
    own = "_target_" in options
    if own or options["name"] in data.SCENE_SETS:
        dataset = presets.instantiate(options, "dataset") if own else data.load(**options)
        if isinstance(dataset, ScenePairs):
            return dataset
    raise ValueError(
        f"dataset={options.get('name', options.get('_target_'))} has no candidates to judge; it must be one of "
        f"{', '.join(data.SCENE_SETS)}, or a `ScenePairs` of your own"
    )


def _select(construction: Construction, team: _Team, progress: Progress) -> tuple[list[int], int, list[str]]:
    """The candidates that make pairs, how many were judged for that, and what was wrong with images."""
    order = construction.order()
    total = len(order) if construction.count is None else min(construction.count, len(order))
    bar = progress.add_task("judging candidates" if construction.count is None else "finding pairs", total=total)
    kept, judged, problems = list[int](), 0, dict[str, None]()
    here, there = itertools.tee(blocks(order))
    for (_, ranks), verdicts in zip(here, team.each("judge", there), strict=False):
        passed = [rank for rank, good in zip(ranks, verdicts.kept, strict=True) if good]
        kept += passed
        judged += len(ranks)
        problems.update(dict.fromkeys(verdicts.problems))
        progress.update(bar, completed=judged if construction.count is None else min(len(kept), total))
        if construction.count is not None and len(kept) >= construction.count:
            break
    return kept[: construction.count], judged, list(problems)


class _Team:
    """Calls methods of a construction with many arguments, here or by several processes; results come in order."""

    def __init__(self, construction: Construction, workers: int) -> None:
        self.construction, self.workers = construction, workers
        self.executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> _Team:
        if self.workers > 1:
            context = multiprocessing.get_context("spawn")
            self.executor = ProcessPoolExecutor(
                self.workers, context, initializer=_begin, initargs=(self.construction,)
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self.executor is not None:
            self.executor.shutdown(wait=True, cancel_futures=True)

    def each(self, method: str, arguments: Iterable[tuple[object, ...]]) -> Iterator[Any]:
        """The results, some of them computed ahead."""
        if self.executor is None:
            for given in arguments:
                yield getattr(self.construction, method)(*given)
            return
        waiting: list[Future[Any]] = []
        todo = iter(arguments)
        try:
            with env_override(_ONE_THREAD):  # of the processes, which the first calls start
                for given in todo:
                    waiting.append(self.executor.submit(_in_process, method, given))
                    if len(waiting) > 2 * self.workers:
                        yield waiting.pop(0).result()
                while waiting:
                    yield waiting.pop(0).result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                "a worker process ended before its time, perhaps for want of memory: the same command goes on from "
                "there; fewer workers need less of it"
            ) from error
        finally:
            for future in waiting:
                future.cancel()


_construction: Construction | None = None  # of a process that works for another


def _begin(construction: Construction) -> None:
    """The start of a process: an interrupt is for the one that asked, which waits for what is under way."""
    global _construction
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    cv2.setNumThreads(1)
    _construction = construction


def _in_process(method: str, given: tuple[object, ...]) -> Any:
    assert _construction is not None
    return getattr(_construction, method)(*given)


def _tell(construction: Construction, summary: dict[str, int], problems: list[str], seconds: float) -> None:
    """What was made, on the console."""
    judged = f"{summary['judged']} of {summary['candidates']} candidates were judged in {seconds:.0f} s"
    console.print(f"{summary['kept']} pairs of {summary['images']} images; {judged}", highlight=False)
    if construction.count is not None and summary["kept"] < construction.count:
        console.print(f"no more pass the rule than these; {construction.count} were asked for", highlight=False)
    if problems:
        console.print(
            f"{len(problems)} candidates or images cannot be used{_first(problems)}", markup=False, highlight=False
        )
    console.print(
        f"[dim]python -m fmtorch.eval dataset=fmbench dataset.root={construction.folder}[/dim]", highlight=False
    )


def _first(problems: list[str]) -> str:
    return f", the first because: {problems[0]}" if problems else ""


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config)


def main() -> None:
    """The command."""
    paths = [*path_fields(Fields), "dataset.root"]
    run_command("pairs", task, paths=paths, interrupted="interrupted; the same command goes on from there")
