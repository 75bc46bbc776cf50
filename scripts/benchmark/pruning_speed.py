"""GMS against OpenCV's, one thread each, interleaved in one run; and how LPM's time grows with the matches.

Processor time, which other work on the machine disturbs less than the time on the wall.
"""

from __future__ import annotations

import functools
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fmtorch.pruning import gms, lpm

PEER = Path(__file__).resolve().parent / "opencv_gms.py"
SIZE = (960, 1280)
FACTOR = 4.0
COUNTS, PAIRS = (500, 2000, 10_000), 64
LPM_COUNTS = (1000, 5000, 20_000, 50_000)


def measure(contrib_python: str, repeats: int) -> list[dict[str, Any]]:
    """Lines of a table: our milliseconds of processor time a pair, the peer's, and their ratio."""
    lines = []
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen([contrib_python, str(PEER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as peer,
    ):
        lines += [
            _against_opencv(peer, Path(folder) / f"{n}-{searched}-{pairs}.npz", n, searched, pairs, repeats)
            for n in COUNTS
            for searched in (False, True)
            for pairs in (1, PAIRS)
        ]
    for n in LPM_COUNTS:
        points = [x[None] for x in moving(n, 0)]
        ours = [_milliseconds(functools.partial(lpm, *points)) for _ in range(max(3, repeats // 10))]
        lines.append(_line("LPM", n, 1, ours, None))
    return lines


def moving(n: int, seed: int) -> tuple[Tensor, Tensor]:
    """Matches of two images of SIZE that turn and grow a little, four in ten of them wrong."""
    rng = np.random.default_rng(seed)
    extent = np.array(SIZE[::-1])
    x0 = rng.uniform(0, 1, (n, 2)) * (extent - 1)
    x1 = (x0 - extent / 2) @ np.array([[0.95, 0.1], [-0.1, 0.95]]) + extent / 2 + rng.normal(0, 2, (n, 2))
    wrong = rng.random(n) < 0.4
    x1[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * (extent - 1)
    return torch.from_numpy(x0).float(), torch.from_numpy(x1.clip(0, extent - 1)).float()


def _against_opencv(peer: Any, path: Path, n: int, searched: bool, pairs: int, repeats: int) -> dict[str, Any]:
    cases = [moving(n, seed) for seed in range(pairs)]
    x0, x1 = (torch.stack(points) for points in zip(*cases, strict=True))
    sizes = {name: torch.tensor([SIZE] * pairs) for name in ("size0", "size1")}
    options = {"with_rotation": searched, "with_scale": searched, "threshold_factor": FACTOR}
    np.savez(
        path, x0=x0[0], x1=x1[0], size0=SIZE, size1=SIZE, rotation=searched, scale=searched, factor=FACTOR,
    )  # fmt: skip
    kept = int(gms(x0, x1, **sizes, **options)[0].sum())
    ours, theirs = [], []
    for _ in range(repeats if pairs == 1 or not searched else max(3, repeats // 10)):
        ours.append(_milliseconds(functools.partial(gms, x0, x1, **sizes, **options)) / pairs)
        peer.stdin.write(f"{path}\n")
        peer.stdin.flush()
        milliseconds, count = peer.stdout.readline().split()
        if int(count) != kept:
            raise RuntimeError(f"GMS keeps {kept} of {n} matches, OpenCV's {count}: the timings would mean nothing")
        theirs.append(float(milliseconds))
    return _line("GMS, rotation and scale" if searched else "GMS", n, pairs, ours, theirs)


def _milliseconds(function: Callable[[], Any]) -> float:
    start = time.process_time()
    function()
    return 1e3 * (time.process_time() - start)


def _line(what: str, n: int, pairs: int, ours: list[float], theirs: list[float] | None) -> dict[str, Any]:
    line = {"": what, "matches": n, "pairs a call": pairs, "fmtorch, least": f"{min(ours):.2f}"}
    line |= {"fmtorch, median": f"{np.median(ours):.2f}", "OpenCV, least": "", "OpenCV, median": "", "ratio": ""}
    if theirs is not None:
        ratio = np.median(np.array(ours) / np.array(theirs))
        line |= {"OpenCV, least": f"{min(theirs):.2f}", "OpenCV, median": f"{np.median(theirs):.2f}"}
        line["ratio"] = f"{ratio:.2f}"
    return line
