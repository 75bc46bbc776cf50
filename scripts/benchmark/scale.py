"""What evaluation costs at any size: stages, workers, bytes and memory."""

import argparse
import functools
import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fmtorch.data import ImagePair
from fmtorch.evaluation.run import evaluate_pairs, select
from fmtorch.evaluation.statistics import summarize
from fmtorch.jobs.execution import Execution
from fmtorch.jobs.runner import Factory, Local, TaskRunner, WorkerPool
from fmtorch.runs import PairRow, RunFolder
from fmtorch.scenes import RenderedPairs
from scripts.benchmark.methods import pipeline_of
from scripts.benchmark.pairs import synthetic_pair
from scripts.benchmark.runner import add_command
from scripts.benchmark.tables import Record, Sheet, show

PIPELINES = {"given matches": "given_fmtorch", "SIFT": "sift_fmtorch", "HesAffNet": "hesaffnet_fmtorch"}
STAGES = ("features", "matching", "pruning", "estimation", "metrics")
MATCHES = 500  # of a pair of given matches
WAIT = 0.04  # seconds of a stage that only waits
BATCH = 64  # rows that are stored at a time where memory is measured


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "scale", run, __doc__)
    parser.add_argument("--pairs", type=int, default=1000, help="of given matches; of the others a tenth")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--executors", nargs="+", default=["threads", "processes", "dask"])
    parser.add_argument("--batches", type=int, default=1000, help="that a scheduler is given to do nothing in")
    parser.add_argument("--rows", type=int, nargs="+", default=[10_000, 1_000_000], help="at which memory is measured")
    parser.add_argument("--parts", nargs="+", default=["workers", "memory", "stages"], help="of the tables")


def run(arguments: argparse.Namespace) -> None:
    sheets = []
    if "workers" in arguments.parts:
        sheets.append(worker_sheet(arguments.executors, arguments.workers, arguments.batches))
    if "memory" in arguments.parts:
        sheets.append(memory_sheet(arguments.rows))
    if "stages" in arguments.parts:
        with tempfile.TemporaryDirectory() as folder:
            sheets += stage_sheets(Path(folder), arguments.pairs)
    show(sheets, arguments.table)


def stage_sheets(folder: Path, count: int) -> list[Sheet]:
    """Milliseconds of each stage by one worker, and what a million and a billion pairs cost at that speed."""
    stages: list[Record] = []
    costs: list[Record] = []
    size = 0.0  # bytes of a row
    for name, pipeline in PIPELINES.items():
        if name == "given matches":
            every = select([synthetic_pair(i, MATCHES) for i in range(count)], None)
        else:
            every = select(list(RenderedPairs("test", size="small")), None)[: max(count // 10, 1)]
        stored, built = RunFolder.open(folder / pipeline, {"pipeline": pipeline}), pipeline_of(pipeline)
        evaluated(built, every[:2], [].extend)  # compiles and loads
        start = time.perf_counter()
        evaluated(built, every, stored.append)
        wall = time.perf_counter() - start
        rows = stored.read()
        ms = {s: 1e3 * sum(v or 0.0 for v in rows[f"seconds_{s}"].to_pylist()) / len(every) for s in STAGES}
        ms["rest"] = max(1e3 * wall / len(every) - sum(ms.values()), 0.0)
        hours = 1e6 * wall / len(every) / 3600
        size = size or sum(path.stat().st_size for path in (stored.path / "pairs").iterdir()) / len(every)
        stages.append({"pipeline": name, "pairs": len(every), **{f"{s}, ms": f"{v:.1f}" for s, v in ms.items()},
                       "pairs a second and core": f"{len(every) / wall:.1f}"})  # fmt: skip
        costs.append({"pipeline": name, "core hours of 10^6 pairs": f"{hours:.0f}", "of 10^9": f"{1e3 * hours:.0f}",
                      "rows of 10^6, GB": f"{size / 1e3:.2f}", "of 10^9, TB": f"{size / 1e3:.2f}"})  # fmt: skip
    return [Sheet("stages", "Stages, by one worker", stages), Sheet("extrapolated", "Extrapolated", costs)]


def evaluated(pipeline: Any, pairs: Sequence[ImagePair], store: Any) -> None:
    for _ in evaluate_pairs(pipeline, pairs, seed=0, batch=16, execution=Execution("threads", 1), store=store):
        pass


def worker_sheet(executors: Sequence[str], workers: Sequence[int], batches: int) -> Sheet:
    """Efficiency of waiting, the time of one worker by their number over that taken; calls a second of nothing."""
    records: list[Record] = []
    for executor in executors:
        line: Record = {"executor": executor}
        for count in workers:
            efficiency = 100 * WAIT * 50 / _timed(executor, count, WAIT, 50 * count)
            line[f"{count} worker{'s' * (count > 1)}: efficiency, %"] = f"{efficiency:.0f}"
        records.append(line | {"batches a second": f"{batches / _timed(executor, workers[-1], 0.0, batches):.0f}"})
    return Sheet("workers", f"Batches that only wait {1e3 * WAIT:.0f} ms, and such as do nothing", records)


def _timed(executor: str, workers: int, seconds: float, count: int) -> float:
    """Seconds of so many calls from the first result on, when all workers have started."""
    execution = Execution(executor, workers)
    source: Any = Local(seconds) if execution.shared else Factory(functools.partial(float, seconds))
    warm = 4 * workers
    start = 0.0
    with WorkerPool(execution) as pool:
        runner = TaskRunner[int](pool, source, wait, lambda task, result: None)
        for done, _ in enumerate(runner.each(range(warm + count))):
            if done == warm:
                start = time.perf_counter()
        return time.perf_counter() - start


def wait(seconds: float, job: int) -> int:
    """A stage that only waits."""
    time.sleep(seconds)
    return job


def memory_sheet(rows: Sequence[int]) -> Sheet:
    """Peak memory of a caller that stores, lists and sums up rows, each time in a process of its own."""
    records: list[Record] = []
    for count in rows:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            records.append({"rows": count, **{k: f"{v:.0f}" for k, v in pool.apply(stored, (count,)).items()}})
    return Sheet("memory", "Memory of the caller, each column the peak up to then", records)


def stored(count: int) -> dict[str, float]:
    """Peaks after imports, storing, finding what is done and the summary; seconds, parts and bytes of storing."""
    figures: dict[str, float] = {"imports, MB": _peak()}
    with tempfile.TemporaryDirectory() as name:
        folder = RunFolder.open(Path(name) / "run", {"rows": count})
        start = time.perf_counter()
        with WorkerPool(Execution("threads", 2)) as pool:
            runner = TaskRunner[range](pool, Local(None), rows_of, lambda task, rows: folder.append(rows))
            for _ in runner.each(range(i, min(i + BATCH, count)) for i in range(0, count, BATCH)):
                pass
        seconds = time.perf_counter() - start
        figures["storing, MB"] = _peak()
        files = list((folder.path / "pairs").iterdir())
        assert len(folder.done()) == count
        figures["finding what is done, MB"] = _peak()
        summarize(folder.read(without=("pair", "F")))
        size = sum(file.stat().st_size for file in files) / count
        return figures | {
            "summary, MB": _peak(), "storing, s": seconds, "parts": len(files), "bytes a row on disk": size
        }  # fmt: skip


def rows_of(nothing: None, numbers: range) -> list[PairRow]:
    """Rows as of solved pairs."""
    rows = []
    for i in numbers:
        name, F = f"family/scene{i // 1000}/im{i:07d}-im{i + 1:07d}", [0.1234567 * k + 1e-9 * i for k in range(1, 10)]
        seconds: Any = {f"seconds_{stage}": 1e-3 + 1e-9 * i for stage in STAGES}
        figures: Any = {"nsgd": (i % 997) / 997, "inlier_rate": 0.9, "F": F, "corrs": i % 400, "corrs_before": 500}
        rows.append(PairRow(name, i, "family", f"scene{i // 1000}", ok=True, **figures, **seconds))
    return rows


def _peak() -> float:
    """MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
