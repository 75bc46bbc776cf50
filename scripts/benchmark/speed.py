"""Milliseconds a pair of estimators and pruners, one thread: one pair a call and many, peers interleaved, prior included.

python -m scripts.benchmark speed --estimators fmtorch msac:confidence=null --peers poselib opencv:method=usac_magsac
python -m scripts.benchmark speed --device cuda --batch 4000 --pairs 4000 --peers --estimators msac:confidence=null
python -m scripts.benchmark speed --estimators @gms @lpm @code --matches 2000 --peers         # pruners alone
FMTORCH_CACHE=$(mktemp -d) python -m scripts.benchmark speed --peers    # the first call compiles the kernels
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import torch

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from fmtorch.matching import nearest_neighbors
from scripts.benchmark import pairs
from scripts.benchmark.methods import call
from scripts.benchmark.runner import add_command, console, peak_growth, turns
from scripts.benchmark.tables import Record, Sheet, show

SINGLE = 64  # pairs at most that are estimated one a call
MEMORY = "Peak memory of estimators and pruners: how far the resident set grows during one call, each in a process alone."
MATCHING = "Exhaustive two-nearest-neighbour matching against OpenCV's brute-force matcher, one thread each."


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "speed", run, __doc__)
    pairs.add_match_options(parser)
    parser.add_argument("--matches", type=int, default=760, help="median of the synthetic pairs, used without --root")
    parser.add_argument("--pairs", type=int, default=64, help="synthetic pairs")
    parser.add_argument("--batch", type=int, default=64, help="pairs a call; 0: only single calls, 1 pair each")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--estimators", nargs="+", default=["fmtorch@frame_consistency"], help="PRESET[:...][@PRUNER...]")
    parser.add_argument("--peers", nargs="*", default=["poselib", "opencv:method=usac_magsac"], help="of the ratios")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--workers", type=int, help="also pairs a second, by the clock, of so many threads and processes")
    parser = add_command(commands, "memory", run_memory, MEMORY)
    parser.add_argument("--estimators", nargs="+", help="PRESET[:KEY=VALUE,...][@PRUNER...]; default: all our own")
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--matches", type=int, default=8000)
    parser = add_command(commands, "matching", run_matching, MATCHING)
    parser.add_argument("--features", type=int, nargs="+", default=[2000, 5000, 8000])
    parser.add_argument("--repeats", type=int, default=5)


def run(arguments: argparse.Namespace) -> None:
    begin(arguments.threads)
    device = presets.resolve_device(arguments.device)
    if pairs.named(arguments):
        every = [item.matches for item in pairs.matched(arguments)]
    else:
        every = [pairs.synthetic_pair(i, arguments.matches) for i in range(arguments.pairs)]
    every = [c.to(device) for c in every]
    counts = np.array([int(c.count()) for c in every])
    console.print(f"{len(every)} pairs, {np.median(counts):.0f} matches (median; {counts.min()} to {counts.max()})")
    methods = {spec: call(spec) for spec in (*arguments.peers, *arguments.estimators)}
    first = {spec: seconds(method, every[0]) for spec, method in methods.items()}  # lazy initialisation
    single = alternating(methods, every[:SINGLE], arguments.repeats)
    batches = [collate(every[i : i + arguments.batch]) for i in range(0, len(every), arguments.batch)] if arguments.batch else []
    if device.type == "cuda":
        alternating(methods, batches[:1], 1)
    many = alternating(methods, batches, arguments.repeats)
    records: list[Record] = []
    for spec in methods:
        line: Record = {"estimator": spec, "one pair a call: median ms": f"{1e3 * np.median(single[spec]):.2f}"}
        line["one pair a call: mean ms"] = f"{1e3 * single[spec].mean():.2f}"
        if batches:
            name = f"{arguments.batch} pairs a call: ms"
            line[name] = f"{1e3 * np.median(many[spec].sum(1)) / len(every):.2f}"
        line["first call, s"] = f"{first[spec]:.1f}"
        line |= {f"median / {peer}": f"{np.median(single[spec]) / np.median(single[peer]):.2f}" for peer in arguments.peers}
        if arguments.workers:
            line |= rates(spec, methods[spec], every, arguments)
        records.append(line)
    show([Sheet("speed", "Milliseconds a pair", records)], arguments.table)


def begin(threads: int, spec: str | None = None) -> None:
    """The start of a process; spec: what it works on for another."""
    global _mine
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    _mine = None if spec is None else call(spec)


_mine: Callable[[Correspondences], Any] | None = None


def _in_process(c: Correspondences) -> Any:
    assert _mine is not None
    return _mine(c)


def seconds(method: Callable[[Correspondences], Any], c: Correspondences) -> float:
    """The time of one call, until its results are there: of the processor on a CPU, whatever else runs beside it."""
    clock = time.process_time if c.mask.device.type == "cpu" else time.perf_counter
    start = clock()
    made = method(c)
    (made.mask if isinstance(made, Correspondences) else made.ok).cpu()
    return clock() - start


def alternating(
    methods: dict[str, Callable[[Correspondences], Any]], inputs: Sequence[Correspondences], repeats: int
) -> dict[str, np.ndarray]:
    """Seconds (repeats, inputs) of methods that take turns at each input."""
    taken = {spec: np.zeros((repeats, len(inputs))) for spec in methods}
    for repeat in range(repeats):
        for i, c in enumerate(inputs):
            for spec, method in methods.items():
                taken[spec][repeat, i] = seconds(method, c)
    return taken


def rates(spec: str, method: Callable[[Correspondences], Any], every: list[Correspondences], arguments: Any) -> Record:
    """Pairs a second by the clock, of one worker, threads and processes that share batches."""
    workers, repeats = arguments.workers, arguments.repeats
    size = min(arguments.batch or 1, -(-len(every) // (4 * workers)))  # some batches for each worker
    batches = [collate(every[i : i + size]) for i in range(0, len(every), size)]
    figures = {}
    for name, count in (("one worker", 1), ("threads", workers)):
        with ThreadPoolExecutor(count) as pool:
            figures[name] = len(every) / _shared_seconds(pool, method, batches, count, repeats)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, begin, (arguments.threads, spec)) as pool:
        figures["processes"] = len(every) / _shared_seconds(pool, _in_process, batches, workers, repeats)
    return {f"{name}: pairs a second": f"{rate:.1f}" for name, rate in figures.items()}


def _shared_seconds(
    pool: Executor, method: Callable[[Correspondences], Any], batches: list[Correspondences], workers: int, repeats: int
) -> float:
    """The time by the clock until all workers together have done all batches, at best."""
    list(pool.map(method, batches[:1] * workers))  # the workers are there
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        list(pool.map(method, batches))
        times.append(time.perf_counter() - start)
    return min(times)


def run_memory(arguments: argparse.Namespace) -> None:
    own = [name for name in presets.available("estimator") if not _is_peer(name)]
    context = multiprocessing.get_context("spawn")
    records: list[Record] = []
    for spec in arguments.estimators or own:
        with context.Pool(1) as pool:  # memory once claimed stays claimed, so each has a fresh process
            size, growth = pool.apply(peak, (spec, arguments.pairs, arguments.matches))
        console.print(f"{spec}: {growth:.0f} MiB", highlight=False)
        records.append({"estimator": spec, "input, MiB": f"{size:.0f}", "peak growth, MiB": f"{growth:.0f}"})
    show([Sheet("memory", f"{arguments.pairs} pairs of {arguments.matches} matches", records)], arguments.table)


def _is_peer(name: str) -> bool:
    """Whether a preset is another library's estimator: what makes those is a function, ours are classes."""
    target = str(presets.load("estimator", name)["_target_"])
    return target.rpartition(".")[2].islower()


def peak(spec: str, count: int, matches: int) -> tuple[float, float]:
    """MiB of the input, and by how much the peak of one call exceeds what was resident before."""
    torch.set_num_threads(1)
    method = call(spec)
    method(pairs.synthetic_pair(0, 200, 0))  # lazy initialisation is not counted
    c = collate([pairs.synthetic_pair(i, matches, 0) for i in range(count)])
    size = sum(value.nbytes for value in vars(c).values() if isinstance(value, torch.Tensor)) / 2**20
    return size, peak_growth(lambda: method(c))


def run_matching(arguments: argparse.Namespace) -> None:
    records: list[Record] = []
    for n in arguments.features:
        for kind, make in KINDS.items():
            d0, d1 = make(0, n), make(1, n)
            t0, t1 = torch.from_numpy(d0), torch.from_numpy(d1)
            nearest_neighbors(t0, t1)  # compiles
            calls = {"ms": functools.partial(nearest_neighbors, t0, t1),
                     "OpenCV, ms": functools.partial(cv2.BFMatcher(cv2.NORM_L2).knnMatch, d0, d1, k=2)}  # fmt: skip
            ms = turns(calls, arguments.repeats)
            line: Record = {"features": n, "descriptors": kind, **{name: f"{np.median(v):.0f}" for name, v in ms.items()}}
            records.append(line | {"ratio": f"{np.median(ms['ms'] / ms['OpenCV, ms']):.2f}"})
    show([Sheet("matching", f"Processor time, medians of {arguments.repeats}", records)], arguments.table)


def sift_like(seed: int, n: int) -> np.ndarray:
    """Non-negative integers of norm about 512, as OpenCV's SIFT has them."""
    values = np.random.default_rng(seed).gamma(0.6, 45, (n, 128))
    return np.minimum(values, 255).round().astype(np.float32)


def rootsift_like(seed: int, n: int) -> np.ndarray:
    """Square roots of histograms."""
    values = sift_like(seed, n)
    return np.asarray(np.sqrt(values / values.sum(1, keepdims=True)))


def unit(seed: int, n: int) -> np.ndarray:
    """Directions at random, as far from one another as a network's descriptors ever are."""
    values = np.random.default_rng(seed).normal(size=(n, 128)).astype(np.float32)
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True))


KINDS = {"SIFT-like": sift_like, "RootSIFT-like": rootsift_like, "unit vectors": unit}
