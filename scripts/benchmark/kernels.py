"""Pruners by kernels and by tensors, interleaved, and estimators: milliseconds of processor time, seconds to compile.

    python -m scripts.benchmark.kernels [pruning] [estimators]

On synthetic matches of one pair. Processor time, which other work on the machine disturbs less than the time on the
wall; compiled into an empty cache folder.
"""

from __future__ import annotations

import functools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from fmtorch import presets
from fmtorch.core.types import Correspondences
from fmtorch.jit import kernel
from scripts.benchmark.matched import pruner
from scripts.benchmark.pruning_speed import correspondences

COUNT = 600  # matches of the pair
REPEATS = 15
PRUNERS = (
    "frame_consistency", "position_consistency", "match_noise", "ratio_prior", "one_to_one", "gms", "gms:soft=true",
    "lpm",
)  # fmt: skip
ESTIMATORS = (
    "fmtorch", "fmtorch_fast", "ransac", "msac", "lmeds", "usac", "magsac", "gc_ransac", "cf_ransac",
    "irls",
)  # fmt: skip


def main(groups: list[str]) -> None:
    """Print a line for each kernel."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FMTORCH_CACHE"] = folder
        c = framed(correspondences(COUNT))
        measured = {"pruning": pruning, "estimators": estimators}
        for group in groups or list(measured):
            measured[group](c)


def line(name: str, compiled: Callable[[], Any], tensors: Callable[[], Any] | None) -> None:
    """Print compile seconds and the medians of interleaved calls."""
    seconds = milliseconds(compiled, 1) / 1e3
    ours, theirs = [], []
    for _ in range(REPEATS):
        ours.append(milliseconds(compiled, 5))
        if tensors is not None:
            theirs.append(milliseconds(tensors, 1))
    reference = f"{np.median(theirs):8.3f}" if theirs else "        "
    print(f"{name:24} {seconds:6.1f} s  {np.median(ours):8.3f} ms  {reference} ms", flush=True)


def milliseconds(call: Callable[[], Any], times: int) -> float:
    """Of processor time a call."""
    begun = time.process_time()
    for _ in range(times):
        call()
    return (time.process_time() - begun) / times * 1e3


def framed(c: Correspondences) -> Correspondences:
    """The same matches with frames."""
    frames = torch.from_numpy(np.random.default_rng(0).normal(size=(1, COUNT, 2, 3))).float()
    return c.replace(lafs0=frames, lafs1=frames * 1.1)


def pruning(c: Correspondences) -> None:
    """Pruners as stages."""
    time_stages(PRUNERS, c)


def estimators(c: Correspondences) -> None:
    """Whole estimators; the seconds are those of kernels that none before it has compiled."""
    for name in ESTIMATORS:
        line(name, functools.partial(presets.build("estimator", name), c), None)


def time_stages(names: Sequence[str], c: Correspondences) -> None:
    """Pruners, called with kernels and without."""
    for name in names:
        stage = pruner(name)

        def run(form: str, stage: Any = stage) -> None:
            os.environ[kernel.SWITCH] = form
            stage(c)

        line(name, functools.partial(run, "on"), functools.partial(run, "off"))
    os.environ[kernel.SWITCH] = "on"


if __name__ == "__main__":
    main(sys.argv[1:])
