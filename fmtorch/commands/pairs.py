"""`fmtorch pairs dataset=kitti dataset.root=DIR output=KITTI`: a set of the pairs that can be matched."""

import copy
import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import DictConfig
from rich.progress import Progress

from fmtorch import data, presets
from fmtorch.commands.config import job, run_command
from fmtorch.commands.options import PAIRS, PairsOptions
from fmtorch.core.files import counted
from fmtorch.core.terminal import console, progress_bars, reporter
from fmtorch.data.construction import BLOCK, Construction, blocks
from fmtorch.data.pairs import HeldPairs
from fmtorch.data.scenes import ScenePairs, image_pair
from fmtorch.jobs import Execution, Factory, Local, Source, WorkerPool, in_order
from fmtorch.presets.composition import execution_of, plain, read_fields
from fmtorch.runs.fingerprint import digest
from fmtorch.scenes import RenderedPairs
from fmtorch.training.matched_pairs import MatchedPairs, stages_before_estimation, write_oanet

MIN_CANDIDATES_FOR_PROCESSES = 4 * BLOCK + 1  # below which processes are not worth their start
PRELOADED = (Construction.__module__,)  # by the process that workers are forked of
T = TypeVar("T")


def run(config: DictConfig) -> Path:
    """Make the set that a composed config describes and return its folder.
    Raises ValueError, before anything is computed or written, where an option is not what it may be."""
    fields = read_fields(PairsOptions, config)
    if fields.output is None:
        raise ValueError("output is missing; it names the folder of the set that is made: output=KITTI")
    dataset = _load(config.dataset)
    overlap = None if fields.overlap is None else (float(fields.overlap[0]), float(fields.overlap[1]))
    of_matches = None if fields.layout == "fmbench" else {g: plain(config[g]) for g in ("features", "matcher")}
    settings = fields.count, fields.seed, fields.quality, overlap, of_matches
    construction = Construction(dataset, fields.output, *settings)
    construction.begin()
    if construction.complete:
        console.print(f"{construction.folder} is complete: {_use(construction)}")
        return construction.folder
    asked = execution_of(config, fields.workers)
    many = dataset.candidates >= MIN_CANDIDATES_FOR_PROCESSES if asked.workers is None else asked.workers > 1
    execution = asked.decided(many)
    if execution.shared and asked.workers is None:
        execution = dataclasses.replace(execution, workers=1)  # here
    start = time.monotonic()
    with progress_bars() as progress:
        kept, judged, problems = _select(construction, execution, progress)
        images = construction.used(kept)
        if of_matches is None:
            bar = progress.add_task("writing images", total=len(images))
            for _ in _each(construction, execution, Construction.write_image, images):
                progress.advance(bar)
        elif kept:
            _write_matches(config, construction, kept, asked, progress)
    if not kept:
        none = f"none of {judged} candidates passes the rule{_first(problems)}"
        raise ValueError(f"{none}; {construction.folder} was not completed")
    summary = {"candidates": dataset.candidates, "judged": judged, "kept": len(kept), "images": len(images)}
    construction.finish(kept, summary)
    _print_summary(construction, summary, problems, time.monotonic() - start)
    return construction.folder


def _load(config: DictConfig) -> ScenePairs:
    options = plain(config)
    presets.expect_buildable(options, "dataset")
    with progress_bars() as progress:
        dataset = data.build(options, reporter(progress, "drawing scenes"))
    if isinstance(dataset, RenderedPairs):
        return dataset.scene_pairs()
    if not isinstance(dataset, ScenePairs):
        allowed = "tum, kitti, colmap, bundler, cameras, rendered, or a `ScenePairs` of your own"
        raise ValueError(f"dataset={dataset.name} has no candidates to judge; it must be one of {allowed}")
    return dataset


def _select(construction: Construction, execution: Execution, progress: Progress) -> tuple[list[int], int, list[str]]:
    """The candidates that make pairs, how many were judged for that, and what was wrong with images."""
    order = construction.order()
    total = len(order) if construction.count is None else min(construction.count, len(order))
    bar = progress.add_task("judging candidates" if construction.count is None else "finding pairs", total=total)
    kept, judged, problems = list[int](), 0, dict[str, None]()
    here, there = itertools.tee(blocks(order))
    for (_, ranks), verdicts in zip(here, _each(construction, execution, Construction.judge, there), strict=False):
        kept += [rank for rank, good in zip(ranks, verdicts.kept, strict=True) if good]
        judged += len(ranks)
        problems.update(dict.fromkeys(verdicts.problems))
        progress.update(bar, completed=judged if construction.count is None else min(len(kept), total))
        if construction.count is not None and len(kept) >= construction.count:
            break
    return kept[: construction.count], judged, list(problems)


def _each(
    construction: Construction, execution: Execution, method: Callable[[Construction, T], Any], tasks: Iterable[T]
) -> Iterator[Any]:
    """The results of a method of the construction, in order, some of them computed ahead by workers."""
    if execution.shared and execution.workers == 1:  # here, and none ahead
        yield from (method(construction, task) for task in tasks)
        return
    here, elsewhere = Local(construction), Factory(functools.partial(copy.copy, construction))
    source: Source[Construction] = here if execution.shared else elsewhere
    with WorkerPool(execution, PRELOADED) as pool:
        for _, result in in_order(pool, source, method, tasks):
            yield result


def _print_summary(construction: Construction, summary: dict[str, int], problems: list[str], seconds: float) -> None:
    judged = f"{summary['judged']} of {summary['candidates']} candidates were judged in {seconds:.0f} s"
    console.print(f"{counted(summary['kept'], 'pair')} of {summary['images']} images; {judged}")
    if construction.count is not None and summary["kept"] < construction.count:
        console.print(f"no more pass the rule than these; {construction.count} were asked for")
    if problems:
        console.print(f"{len(problems)} candidates or images cannot be used{_first(problems)}")
    console.print(f"python -m fmtorch.eval {_use(construction)}", style="dim")


def _use(construction: Construction) -> str:
    kind = "dataset=fmbench" if construction.matches is None else "dataset=h5 dataset.layout=oanet"
    return f"{kind} dataset.root={construction.folder}"


def _write_matches(
    config: DictConfig, construction: Construction, ranks: Sequence[int], execution: Execution, progress: Progress
) -> None:
    """Match the pairs of these candidates, which is taken up where it was interrupted, and write OANet's files."""
    chosen = PairsOf(construction, ranks)
    matches = MatchedPairs(
        chosen, stages_before_estimation(config), root=construction.work / "matched", labels="geodesic",
        execution=execution.decided(False), build=functools.partial(stages_before_estimation, config),
        progress=reporter(progress, "matching"),
    )  # fmt: skip
    write_oanet(matches, chosen, construction.folder)


class PairsOf(HeldPairs):
    """The pairs of some candidates of a construction."""

    def __init__(self, construction: Construction, ranks: Sequence[int]) -> None:
        places = sorted(construction.dataset.candidate(rank) for rank in ranks)
        self._pairs = [image_pair(construction.dataset.scenes[scene], i, j) for scene, i, j in places]
        self.name, self.digest = construction.dataset.name, digest(f"{construction.identity} {places}".encode())


def _first(problems: list[str]) -> str:
    return f", the first because: {problems[0]}" if problems else ""


@job
def task(config: DictConfig) -> None:
    """What Hydra runs."""
    run(config)


main = functools.partial(run_command, PAIRS, task)
