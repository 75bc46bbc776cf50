"""Milliseconds a pair of estimators and pruners: one pair a call and many, peers in turn, prior included.

python -m scripts.benchmark speed --estimators fmtorch msac:confidence=null --peers poselib opencv:method=usac_magsac
python -m scripts.benchmark speed --device cuda --batch 4000 --pairs 4000 --peers --estimators msac:confidence=null
python -m scripts.benchmark speed --estimators @gms @lpm @code --matches 2000 --peers         # pruners alone
FMTORCH_CACHE=$(mktemp -d) python -m scripts.benchmark speed --peers    # the first call compiles the kernels
"""

import argparse
import multiprocessing
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import torch

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from scripts.benchmark import pairs
from scripts.benchmark.methods import call
from scripts.benchmark.runner import add_command, console, peak_growth
from scripts.benchmark.tables import Record, Sheet, show

SINGLE = 64  # pairs at most that are estimated one a call
MEMORY = "Peak memory of estimators and pruners: how far one call makes its process grow, each in a process of its own."
Call = Callable[[Correspondences], Any]


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
