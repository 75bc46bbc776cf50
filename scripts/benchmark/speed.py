"""Milliseconds a pair of robust estimators, one thread: one pair a call and many, peers interleaved, prior included.

python -m scripts.benchmark speed --estimators fmtorch msac:confidence=null --peers poselib opencv:method=usac_magsac
python -m scripts.benchmark speed --device cuda --batch 4000 --pairs 4000 --peers --estimators msac:confidence=null
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import platform
import time
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.table import Table

from fmtorch import presets
from fmtorch.core.types import Correspondences, Estimate, collate
from scripts.benchmark.matched import add_arguments as add_matches_arguments
from scripts.benchmark.matched import console, load
from scripts.benchmark.specs import build
from scripts.benchmark.synthetic import synthetic_pair


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("speed", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_matches_arguments(parser)
    parser.add_argument("--matches", type=int, default=760, help="median of the synthetic pairs, used without --root")
    parser.add_argument("--pairs", type=int, default=64, help="synthetic pairs")
    parser.add_argument("--batch", type=int, default=64, help="pairs a call; 0: only single calls, 1 pair each")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--estimators", nargs="+", default=["fmtorch@frame_consistency"], help="PRESET[:KEY=VALUE,...][@PRUNER...]"
    )
    parser.add_argument(
        "--peers", nargs="*", default=["poselib", "opencv:method=usac_magsac"], help="the ratios' reference"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--workers",
        type=int,
        help="also pairs a second, by the clock, of so many threads and processes over batches",
    )
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    device = presets.resolve_device(arguments.device)
    if arguments.root or arguments.rendered:
        pairs = [c for _, c in load(arguments)]
    else:
        pairs = [synthetic_pair(i, arguments.matches) for i in range(arguments.pairs)]
    pairs = [pair.to(device) for pair in pairs]
    counts = np.array([int(pair.count()) for pair in pairs])
    console.print(f"{len(pairs)} pairs, {np.median(counts):.0f} matches (median; {counts.min()} to {counts.max()})")

    specs = [*arguments.peers, *arguments.estimators]
    methods = {spec: functools.partial(build(spec), seed=0) for spec in specs}
    first = {spec: seconds(run_one, pairs[0]) for spec, run_one in methods.items()}  # lazy initialisation
    batches = [collate(pairs[i : i + arguments.batch]) for i in range(0, len(pairs), arguments.batch or len(pairs) + 1)]
    if arguments.batch and device.type == "cuda":
        for run_one in methods.values():
            run_one(batches[0])
    single = {spec: np.zeros((arguments.repeats, len(pairs))) for spec in specs}
    many = {spec: np.zeros(arguments.repeats) for spec in specs}
    for repeat in range(arguments.repeats):
        for i, pair in enumerate(pairs[:64]):
            for spec, run_one in methods.items():
                single[spec][repeat, i] = seconds(run_one, pair)
        for batch in batches if arguments.batch else ():
            for spec, run_one in methods.items():
                many[spec][repeat] += seconds(run_one, batch) / len(pairs)
    figures = {
        spec: {
            "first_call_s": first[spec],
            "ms_median": 1e3 * float(np.median(single[spec][:, : min(64, len(pairs))])),
            "ms_mean": 1e3 * float(single[spec][:, : min(64, len(pairs))].mean()),
            "ms_batch": 1e3 * float(np.median(many[spec])),
        }
        for spec in specs
    }
    if arguments.workers:
        size = min(arguments.batch or 1, -(-len(pairs) // (4 * arguments.workers)))  # some batches for each worker
        batches = [collate(pairs[i : i + size]) for i in range(0, len(pairs), size)]
        for spec, run_one in methods.items():
            for name, workers in (("alone", 1), ("threads", arguments.workers)):
                with ThreadPoolExecutor(workers) as pool:
                    fastest = shared_seconds(pool, run_one, batches, workers, arguments.repeats)
                figures[spec][f"{name}_pairs_s"] = len(pairs) / fastest
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(arguments.workers, context, begin, (spec, arguments.threads)) as pool:
                fastest = shared_seconds(pool, in_process, batches, arguments.workers, arguments.repeats)
            figures[spec]["processes_pairs_s"] = len(pairs) / fastest
    report(figures, arguments.peers)
    if arguments.json:
        machine = {"processor": platform.processor() or platform.machine(), "torch": torch.__version__}
        facts = {"machine": machine, "pairs": len(pairs), "median_matches": float(np.median(counts))}
        arguments.json.write_text(json.dumps({**facts, "figures": figures}, indent=1) + "\n")


def seconds(call: Callable[[Correspondences], Any], c: Correspondences) -> float:
    """The time of one call, until its results are there: of the processor on a CPU, whatever else runs beside it."""
    clock = time.process_time if c.mask.device.type == "cpu" else time.perf_counter
    start = clock()
    call(c).ok.cpu()
    return clock() - start


def shared_seconds(
    pool: Executor, call: Callable[[Correspondences], Any], batches: list[Correspondences], workers: int, repeats: int
) -> float:
    """The time by the clock until all workers together have done all batches, at best."""
    list(pool.map(call, batches[:1] * workers))  # the workers are there
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        list(pool.map(call, batches))
        times.append(time.perf_counter() - start)
    return min(times)


mine: Callable[[Correspondences], Estimate] | None = None  # of a process that works for another


def begin(spec: str, threads: int) -> None:
    """The start of a process."""
    global mine
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    mine = functools.partial(build(spec), seed=0)


def in_process(c: Correspondences) -> Estimate:
    assert mine is not None
    return mine(c)


def report(figures: dict[str, dict[str, float]], peers: list[str]) -> None:
    table = Table(title="milliseconds a pair")
    table.add_column("estimator")
    for column in ("single, median", "mean", "batch", "first call", *(f"median / {peer}" for peer in peers)):
        table.add_column(column, justify="right")
    for spec, f in figures.items():
        ratios = [f"{f['ms_median'] / figures[peer]['ms_median']:.2f}" for peer in peers]
        first = f"{f['first_call_s']:.1f} s"
        table.add_row(spec, f"{f['ms_median']:.2f}", f"{f['ms_mean']:.2f}", f"{f['ms_batch']:.2f}", first, *ratios)
    console.print(table)
    if "processes_pairs_s" in next(iter(figures.values())):
        table = Table("estimator", "one worker", "threads", "processes", "gain", title="pairs a second, over batches")
        for spec, f in figures.items():
            kinds = [f[f"{kind}_pairs_s"] for kind in ("alone", "threads", "processes")]
            table.add_row(spec, *(f"{rate:.1f}" for rate in kinds), f"{kinds[2] / kinds[0]:.2f}")
        console.print(table)
