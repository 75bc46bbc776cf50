"""Milliseconds a pair of estimators and pruners: one pair a call and many, peers in turn, prior included.

python -m scripts.benchmark speed --estimators fmtorch msac:confidence=null --peers poselib opencv:method=usac_magsac
python -m scripts.benchmark speed --device cuda --batch 4000 --pairs 4000 --peers --estimators msac:confidence=null
python -m scripts.benchmark speed --estimators @gms @lpm @code --matches 2000 --peers         # pruners alone
FMTORCH_CACHE=$(mktemp -d) python -m scripts.benchmark speed --peers    # the first call compiles the kernels
"""

import argparse
import ctypes
import functools
import gc
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from fmtorch.evaluation.statistics import STAGES, summarize
from fmtorch.jobs.execution import Execution
from fmtorch.jobs.runner import Factory, Local, TaskRunner, WorkerPool
from fmtorch.runs import PairRow, RunFolder
from scripts.benchmark import pairs
from scripts.benchmark.methods import call
from scripts.benchmark.runner import add_command, console
from scripts.benchmark.tables import Record, Sheet, show

SINGLE = 64  # pairs at most that are estimated one a call
MEMORY = "Peak memory of estimators and pruners: how far one call makes its process grow, each in a process of its own."
SCALE = "What evaluation costs at any size: workers, bytes and memory. Of stages `fmtorch eval` tells the seconds."
PROC = Path("/proc/self")
Call = Callable[[Correspondences], Any]

WAIT = 0.04  # seconds of a stage that only waits
BATCH = 64  # rows that are stored at a time where memory is measured


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "speed", run, __doc__)
    pairs.add_match_options(parser)
    parser.add_argument("--matches", type=int, default=760, help="median of the synthetic pairs, used without --root")
    parser.add_argument("--pairs", type=int, default=64, help="synthetic pairs")
    parser.add_argument("--batch", type=int, default=64, help="pairs a call; 0: only single calls, 1 pair each")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--estimators", nargs="+", default=["fmtorch@frame_consistency"], help="[PRESET][@PRUNER...]")
    parser.add_argument("--peers", nargs="*", default=["poselib", "opencv:method=usac_magsac"], help="of the ratios")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser = add_command(commands, "memory", run_memory, MEMORY)
    parser.add_argument("--estimators", nargs="+", help="[PRESET][@PRUNER...]; default: all our own estimators")
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--matches", type=int, default=8000)
    parser = add_command(commands, "scale", run_scale, SCALE)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--executors", nargs="+", default=["threads", "processes", "dask"])
    parser.add_argument("--batches", type=int, default=1000, help="that a scheduler is given to do nothing in")
    parser.add_argument("--rows", type=int, nargs="+", default=[10_000, 1_000_000], help="at which memory is measured")
    parser.add_argument("--parts", nargs="+", default=["workers", "memory"], help="of the tables")


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    device = presets.resolve_device(arguments.device)
    if pairs.named(arguments):
        every = [item.matches for item in pairs.matched(arguments)]
    else:
        every = [pairs.synthetic_matches(i, arguments.matches) for i in range(arguments.pairs)]
    every = [c.to(device) for c in every]
    methods = {spec: call(spec) for spec in (*arguments.peers, *arguments.estimators)}
    first = {spec: seconds(method, every[0]) for spec, method in methods.items()}  # lazy initialisation
    single = in_turn(methods, every[:SINGLE], arguments.repeats)
    size = arguments.batch
    batches = [collate(every[i : i + size]) for i in range(0, len(every), size)] if size else []
    if device.type == "cuda":
        in_turn(methods, batches[:1], 1)
    many = in_turn(methods, batches, arguments.repeats)
    records: list[Record] = []
    for spec in methods:
        line: Record = {"estimator": spec, "one pair a call: median ms": f"{1e3 * np.median(single[spec]):.2f}"}
        line["one pair a call: mean ms"] = f"{1e3 * single[spec].mean():.2f}"
        if batches:
            line[f"{size} pairs a call: ms"] = f"{1e3 * np.median(many[spec].sum(1)) / len(every):.2f}"
        line["first call, s"] = f"{first[spec]:.1f}"
        for peer in arguments.peers:
            line[f"median / {peer}"] = f"{np.median(single[spec]) / np.median(single[peer]):.2f}"
        records.append(line)
    count = np.median([int(c.count()) for c in every])
    show([Sheet("speed", f"{len(every)} pairs, {count:.0f} matches (median)", records)], arguments.table)


def seconds(method: Call, c: Correspondences) -> float:
    """The time of one call, until its results are there: of the processor on a CPU, whatever else runs beside it."""
    clock = time.process_time if c.mask.device.type == "cpu" else time.perf_counter
    start = clock()
    made = method(c)
    (made.mask if isinstance(made, Correspondences) else made.ok).cpu()
    return clock() - start


def in_turn(methods: dict[str, Call], inputs: Sequence[Correspondences], repeats: int) -> dict[str, np.ndarray]:
    """Seconds (repeats, inputs) of methods that take turns at each input."""
    taken = {spec: np.zeros((repeats, len(inputs))) for spec in methods}
    for repeat in range(repeats):
        for i, c in enumerate(inputs):
            for spec, method in methods.items():
                taken[spec][repeat, i] = seconds(method, c)
    return taken


def run_memory(arguments: argparse.Namespace) -> None:
    targets = {name: str(presets.load("estimator", name)["_target_"]) for name in presets.available("estimator")}
    own = [name for name, target in targets.items() if not target.rpartition(".")[2].islower()]  # peers' are functions
    context = multiprocessing.get_context("spawn")
    records: list[Record] = []
    for spec in arguments.estimators or own:
        with context.Pool(1) as pool:  # memory once claimed stays claimed, so each has a fresh process
            size, growth = pool.apply(peak, (spec, arguments.pairs, arguments.matches))
        console.print(f"{spec}: {growth:.0f} MiB", highlight=False)
        records.append({"estimator": spec, "input, MiB": f"{size:.0f}", "peak growth, MiB": f"{growth:.0f}"})
    show([Sheet("memory", f"{arguments.pairs} pairs of {arguments.matches} matches", records)], arguments.table)


def peak(spec: str, count: int, matches: int) -> tuple[float, float]:
    """MiB of the input, and by how much the peak of one call exceeds what was resident before."""
    torch.set_num_threads(1)
    method = call(spec)
    method(pairs.synthetic_matches(0, 200, 0))  # lazy initialisation is not counted
    c = collate([pairs.synthetic_matches(i, matches, 0) for i in range(count)])
    size = sum(value.nbytes for value in vars(c).values() if isinstance(value, torch.Tensor)) / 2**20
    return size, peak_growth(lambda: method(c))


def peak_growth(call: Callable[[], Any]) -> float:
    """MiB, the peak of the resident set during a call beyond what was resident before it, on Linux.
    What the process claimed before, as for compiled kernels, does not hide it."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed is given back, or the call would use it
    (PROC / "clear_refs").write_text("5")  # the peak is counted from here
    before = _resident("VmRSS")
    call()
    return (_resident("VmHWM") - before) / 1024


def _resident(field: str) -> int:
    """kB; of the process itself, whereas ru_maxrss is inherited."""
    return next(int(line.split()[1]) for line in (PROC / "status").open() if line.startswith(field))


def run_scale(arguments: argparse.Namespace) -> None:
    sheets = []
    if "workers" in arguments.parts:
        sheets.append(worker_sheet(arguments.executors, arguments.workers, arguments.batches))
    if "memory" in arguments.parts:
        sheets.append(memory_sheet(arguments.rows))
    show(sheets, arguments.table)


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
    return Sheet("memory", "Memory of the caller, how far the peak of each step exceeds what it had before", records)


def stored(count: int) -> dict[str, float]:
    """MiB of storing, finding what is done and the summary; seconds, parts and bytes of storing."""
    with tempfile.TemporaryDirectory() as name:
        folder = RunFolder.open(Path(name) / "run", {"rows": count})

        def store() -> None:
            with WorkerPool(Execution("threads", 2)) as pool:
                runner = TaskRunner[range](pool, Local(None), rows_of, lambda task, rows: folder.append(rows))
                for _ in runner.each(range(i, min(i + BATCH, count)) for i in range(0, count, BATCH)):
                    pass

        start = time.perf_counter()
        figures = {"storing, MiB": peak_growth(store)}
        seconds = time.perf_counter() - start
        figures["finding what is done, MiB"] = peak_growth(folder.done)
        figures["summary, MiB"] = peak_growth(lambda: summarize(folder.read(without=("pair", "F"))))
        files = list((folder.path / "pairs").iterdir())
        size = sum(file.stat().st_size for file in files) / count
        return figures | {"storing, s": seconds, "parts": len(files), "bytes a row on disk": size}


def rows_of(nothing: None, numbers: range) -> list[PairRow]:
    rows = []
    for i in numbers:
        name, F = f"family/scene{i // 1000}/im{i:07d}-im{i + 1:07d}", [0.1234567 * k + 1e-9 * i for k in range(1, 10)]
        seconds: Any = {f"seconds_{stage}": 1e-3 + 1e-9 * i for stage in STAGES}
        figures: Any = {"nsgd": (i % 997) / 997, "inlier_rate": 0.9, "F": F, "corrs": i % 400, "corrs_before": 500}
        rows.append(PairRow(name, i, "family", f"scene{i // 1000}", ok=True, **figures, **seconds))
    return rows
