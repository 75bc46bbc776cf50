"""What evaluation costs at any size: stages, workers, bytes and memory; written into docs/scale.md with --write."""

from __future__ import annotations

import argparse
import functools
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from fmtorch.data.pairs import ImagePair
from fmtorch.evaluation.run import evaluate_pairs, select
from fmtorch.evaluation.summary import summarize
from fmtorch.jobs.execution import Execution
from fmtorch.jobs.pool import WorkerPool
from fmtorch.jobs.runner import Factory, Local, TaskRunner
from fmtorch.pipeline.build import load_pipeline
from fmtorch.runs import PairRow, RunFolder
from fmtorch.scenes import RenderedPairs
from scripts.benchmark.scale_pairs import given_pairs

PIPELINES = {"given matches": "given_fmtorch", "SIFT": "sift_fmtorch", "HesAffNet": "hesaffnet_fmtorch"}
STAGES = ("features", "matching", "pruning", "estimation", "metrics")
MATCHES = 500  # of a pair of given matches
WAIT = 0.04  # seconds of a stage that only waits
BATCH = 64  # rows that are stored at a time where memory is measured
PAGE, MARK = Path("docs/scale.md"), "<!-- python -m scripts.benchmark scale --write -->"


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("scale", help=__doc__)
    parser.add_argument("--pairs", type=int, default=1000, help="of given matches; of the others a tenth")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--executors", nargs="+", default=["threads", "processes", "dask"])
    parser.add_argument("--batches", type=int, default=1000, help="that a scheduler is given to do nothing in")
    parser.add_argument("--rows", type=int, nargs="+", default=[10_000, 1_000_000], help="at which memory is measured")
    parser.add_argument("--parts", nargs="+", default=["workers", "memory", "stages"], help="of the page")
    parser.add_argument("--write", action="store_true", help=f"replace the tables of {PAGE}")
    parser.set_defaults(run=run)
    memory = commands.add_parser("scale-memory", help="the memory of a process that stores and sums up so many rows")
    memory.add_argument("rows", type=int)
    memory.set_defaults(run=run_memory)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        sections = [_about()]
        if "workers" in arguments.parts:
            sections += worker_table(arguments.executors, arguments.workers, arguments.batches)
        if "memory" in arguments.parts:
            sections += memory_table(arguments.rows)
        if "stages" in arguments.parts:
            stages, size = stage_table(Path(folder), arguments.pairs)
            sections += [*stages, *cost_table(stages, size)]
    text = "\n".join(sections)
    if arguments.write:
        head = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
        PAGE.write_text(f"{head}{MARK}\n\n{text}\n", encoding="utf-8")
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


def _about() -> str:
    load = os.getloadavg()[0]
    return (
        f"{time.strftime('%Y-%m-%d')}, {platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}, load "
        f"{load:.1f} at the start (times mean little where that is above 1).\n"
    )


def stage_table(folder: Path, count: int) -> tuple[list[str], float]:
    """Milliseconds of each stage, by one worker, and the bytes of a row on disk."""
    lines = [
        "## Stages, by one worker", "", _row("pipeline", "pairs", *(f"{stage}, ms" for stage in STAGES), "rest, ms",
        "pairs a second and core"), "|---|" + "---:|" * (len(STAGES) + 3),
    ]  # fmt: skip
    size = 0.0
    for name, pipeline in PIPELINES.items():
        given = name == "given matches"
        source = (
            given_pairs(folder / "given", count, MATCHES, outliers=0.5)
            if given
            else list(RenderedPairs("test", size="small"))
        )
        pairs = select(source, None)[: count if given else max(count // 10, 1)]
        run = RunFolder.open(folder / pipeline, {"pipeline": pipeline})
        built = load_pipeline(pipeline)
        evaluated(built, pairs[:2], [].extend)  # compiles and loads
        start = time.perf_counter()
        evaluated(built, pairs, run.append)
        wall = time.perf_counter() - start
        table = run.read()
        own = [1e3 * sum(v or 0.0 for v in table[f"seconds_{stage}"].to_pylist()) / len(pairs) for stage in STAGES]
        rest = max(1e3 * wall / len(pairs) - sum(own), 0.0)
        cells = " | ".join(f"{value:.1f}" for value in (*own, rest))
        lines.append(f"| {name} | {len(pairs)} | {cells} | {len(pairs) / wall:.1f} |")
        if given:
            size = sum(path.stat().st_size for path in (run.path / "pairs").iterdir()) / len(pairs)
    lines += ["", "Features count in full for each pair that shows an image, which is computed once.", ""]
    return lines, size


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def evaluated(pipeline: Any, pairs: Sequence[ImagePair], store: Any) -> None:
    for _ in evaluate_pairs(pipeline, pairs, seed=0, batch=16, execution=Execution("threads", 1), store=store):
        pass


def wait(seconds: float, job: int) -> int:
    """A stage that only waits."""
    time.sleep(seconds)
    return job


def _seconds(seconds: float) -> float:
    return seconds


def worker_table(executors: Sequence[str], workers: Sequence[int], batches: int) -> list[str]:
    """Efficiency of waiting, and calls a second of doing nothing."""
    lines = [
        "## Workers", "",
        f"Efficiency: of batches that only wait {1e3 * WAIT:.0f} ms, the time of one worker without any executor by "
        "the number of workers, divided by the time taken. Batches a second: of such as do nothing, the limit.", "",
        f"| executor | {' | '.join(f'{n} workers' for n in workers)} | batches a second |",
        "|---|" + "---:|" * (len(workers) + 1),
    ]  # fmt: skip
    for executor in executors:
        cells = []
        for count in workers:
            number = 50 * count
            cells.append(f"{100 * WAIT * number / count / _timed(executor, count, WAIT, number):.0f} %")
        limit = batches / _timed(executor, workers[-1], 0.0, batches)
        lines.append(f"| {executor} | {' | '.join(cells)} | {limit:.0f} |")
    return [*lines, ""]


def _timed(executor: str, workers: int, seconds: float, count: int) -> float:
    """Seconds of so many calls from the first result on, when all workers have started."""
    execution = Execution(executor, workers)
    source: Any = Local(seconds) if execution.shared else Factory(functools.partial(_seconds, seconds))
    warm = 4 * workers
    start = 0.0
    with WorkerPool(execution) as pool:
        runner = TaskRunner[int](pool, source, wait, lambda task, result: None)
        for done, _ in enumerate(runner.each(range(warm + count))):
            if done == warm:
                start = time.perf_counter()
        return time.perf_counter() - start


def memory_table(rows: Sequence[int]) -> list[str]:
    """Peak memory of a caller that stores, lists and sums up rows."""
    lines = [
        "## Memory of the caller", "", _row("rows", "imports, MB", "storing, MB", "finding what is done, MB",
        "summary, MB", "storing, s", "parts", "bytes a row on disk"), "|---:|" + "---:|" * 7,
    ]  # fmt: skip
    for count in rows:
        command = [sys.executable, "-m", "scripts.benchmark", "scale-memory", str(count)]
        figures = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        lines.append(
            f"| {count:,} | {figures['imports']:.0f} | {figures['storing']:.0f} | {figures['done']:.0f} | "
            f"{figures['summary']:.0f} | {figures['seconds']:.0f} | {figures['parts']} | {figures['bytes']:.0f} |"
        )
    said = (
        "Each column is the peak up to then. Rows are stored as they come; the list of pairs is the data set's own, "
        "some 2 kB a pair, and is not counted."
    )
    return [*lines, "", said, ""]


def run_memory(arguments: argparse.Namespace) -> None:
    figures: dict[str, float] = {"imports": _peak()}
    with tempfile.TemporaryDirectory() as name:
        folder = RunFolder.open(Path(name) / "run", {"rows": arguments.rows})
        start = time.perf_counter()
        with WorkerPool(Execution("threads", 2)) as pool:
            runner = TaskRunner[range](pool, Local(None), rows_of, lambda task, rows: folder.append(rows))
            for _ in runner.each(_batches(arguments.rows)):
                pass
        figures |= {"seconds": time.perf_counter() - start, "storing": _peak()}
        files = list((folder.path / "pairs").iterdir())
        figures |= {"parts": len(files), "bytes": sum(file.stat().st_size for file in files) / arguments.rows}
        assert len(folder.done()) == arguments.rows
        figures["done"] = _peak()
        summarize(folder.read(without=("pair", "F")))
        figures["summary"] = _peak()
    print(json.dumps(figures))


def _batches(rows: int) -> Iterator[range]:
    return (range(i, min(i + BATCH, rows)) for i in range(0, rows, BATCH))


def rows_of(nothing: None, numbers: range) -> list[PairRow]:
    """Rows as of solved pairs."""
    F = [0.1234567 * (i + 1) for i in range(9)]
    return [
        PairRow(
            f"family/scene{i // 1000}/im{i:07d}-im{i + 1:07d}", i, "family", f"scene{i // 1000}", ok=True,
            nsgd=(i % 997) / 997, inlier_rate=0.9, F=[value + 1e-9 * i for value in F], corrs=i % 400, corrs_before=500,
            **{f"seconds_{stage}": 1e-3 + 1e-9 * i for stage in STAGES},  # type: ignore[arg-type]
        )
        for i in numbers
    ]  # fmt: skip


def _peak() -> float:
    """MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def cost_table(stages: Sequence[str], size: float) -> list[str]:
    """What a million and a billion pairs cost, from the speeds of one core."""
    columns = ("pipeline", "core hours of 10^6 pairs", "of 10^9", "rows of 10^6, GB", "of 10^9, TB")
    lines = ["## Extrapolated", "", _row(*columns), "|---|---:|---:|---:|---:|"]
    for line in stages:
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if cells[0] in PIPELINES:
            hours = 1e6 / float(cells[-1]) / 3600
            lines.append(f"| {cells[0]} | {hours:,.0f} | {1e3 * hours:,.0f} | {size / 1e3:.2f} | {size / 1e3:.2f} |")
    said = (
        "With the features of every image computed anew as often as in the pairs measured here. A billion pairs are "
        "for shards: a thousand commands of a million pairs each (`shard=i/1000`)."
    )
    return [*lines, "", said, ""]
