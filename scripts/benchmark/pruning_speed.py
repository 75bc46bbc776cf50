"""Pruners against others' in one run, one thread each, interleaved; and what memory they take.

GMS against OpenCV's matchGMS, LPM against NumPy with SciPy's KD-tree, which is how the authors' Python works. CODE has
no peer. Processor time, which other work on the machine disturbs less than the time on the wall.
"""

from __future__ import annotations

import functools
import multiprocessing
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from fmtorch import presets
from fmtorch.core.types import Correspondences
from fmtorch.pruning import gms, lpm
from scripts.benchmark.peak import peak_growth

PEER = Path(__file__).resolve().parent / "opencv_gms.py"
SIZE = (960, 1280)
FACTOR = 4.0
COUNTS, PAIRS = (500, 2000, 10_000), 64
LPM_COUNTS = (500, 5000, 20_000, 50_000)
CODE_COUNTS = (2000, 20_000)
MEMORY_COUNTS = (5000, 20_000, 50_000)


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
    lines += [_lpm(n, max(3, repeats // 3)) for n in LPM_COUNTS]
    for n in CODE_COUNTS:
        stage, c = presets.build("pruner", "code"), correspondences(n)
        ours = [_milliseconds(functools.partial(stage, c)) for _ in range(max(3, repeats // 3))]
        lines.append(_line("CODE", n, 1, ours, "", []))
    return lines


def memory() -> list[dict[str, Any]]:
    """Lines of a table: MiB by which the peak of a process grows in one call, each in a process of its own."""
    context = multiprocessing.get_context("spawn")
    lines = []
    for name, options in (("gms", {"with_rotation": True, "with_scale": True}), ("lpm", {}), ("code", {})):
        grown = []
        for n in MEMORY_COUNTS:
            with context.Pool(1) as pool:  # memory once claimed stays claimed, so each has a fresh process
                grown.append(f"{pool.apply(_peak_growth, (name, options, n)):.0f}")
        shown = "GMS, rotation and scale" if options else name.upper()
        lines.append({"": shown} | {f"{n} matches": g for n, g in zip(MEMORY_COUNTS, grown, strict=True)})
    return lines


def _peak_growth(name: str, options: dict[str, Any], n: int) -> float:
    torch.set_num_threads(1)
    stage = presets.build("pruner", name, **options)
    stage(correspondences(200))  # lazy initialisation is not counted
    c = correspondences(n)
    return peak_growth(lambda: stage(c))


def correspondences(n: int) -> Correspondences:
    """A pair of `moving` matches with ratios, lower on average for right ones."""
    x0, x1 = (x[None] for x in moving(n, 0))
    ratio = torch.from_numpy(np.random.default_rng(1).uniform(0.2, 1.0, (1, n))).float()
    motion = x1 - (x0 @ torch.tensor([[0.95, 0.1], [-0.1, 0.95]]))
    right = (motion - motion.median(1, keepdim=True).values).norm(dim=-1) < 15
    size = torch.tensor([SIZE])
    return Correspondences(
        x0, x1, torch.ones(1, n, dtype=torch.bool), quality=torch.where(right, ratio, 1 - 0.4 * (1 - ratio)),
        size0=size, size1=size,
    )  # fmt: skip


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
    size = torch.tensor([SIZE] * pairs)
    ours_on = functools.partial(
        gms, x0, x1, size0=size, size1=size, with_rotation=searched, with_scale=searched, threshold_factor=FACTOR
    )
    np.savez(
        path, x0=x0[0], x1=x1[0], size0=SIZE, size1=SIZE, rotation=searched, scale=searched, factor=FACTOR,
    )  # fmt: skip
    kept = int(ours_on()[0].sum())
    ours, theirs = [], []
    for _ in range(repeats if pairs == 1 or not searched else max(3, repeats // 10)):
        ours.append(_milliseconds(ours_on) / pairs)
        peer.stdin.write(f"{path}\n")
        peer.stdin.flush()
        milliseconds, count = peer.stdout.readline().split()
        if int(count) != kept:
            raise RuntimeError(f"GMS keeps {kept} of {n} matches, OpenCV's {count}: the timings would mean nothing")
        theirs.append(float(milliseconds))
    return _line("GMS, rotation and scale" if searched else "GMS", n, pairs, ours, "OpenCV", theirs)


def _lpm(n: int, repeats: int) -> dict[str, Any]:
    x0, x1 = moving(n, 0)
    ours, theirs = [], []
    if not np.array_equal(lpm(x0[None], x1[None])[0].numpy(), lpm_by_trees(x0.numpy(), x1.numpy())):
        raise RuntimeError(f"LPM and its peer keep others of {n} matches: the timings would mean nothing")
    for _ in range(repeats):
        ours.append(_milliseconds(lambda: lpm(x0[None], x1[None])))
        theirs.append(_milliseconds(lambda: lpm_by_trees(x0.numpy(), x1.numpy())))
    return _line("LPM", n, 1, ours, "NumPy, SciPy", theirs)


def lpm_by_trees(
    x0: NDArray[np.floating], x1: NDArray[np.floating], K: int = 6, tau: float = 0.2, thresholds: Any = (0.8, 0.5)
) -> NDArray[np.bool_]:
    """Which matches (N, 2) LPM keeps, of more than a few."""
    points = x0.astype(np.float64), x1.astype(np.float64)
    motion = points[1] - points[0]
    length = (motion**2).sum(1)
    kept = np.ones(len(x0), bool)
    for threshold in thresholds:
        members = np.flatnonzero(kept)
        near0, near1 = (members[KDTree(x[members]).query(x, K + 3)[1]] for x in points)
        dot = (motion[:, None] * motion[near0]).sum(-1)
        a, b = length[:, None], length[near0]
        differs = dot / np.sqrt(a * b) * np.minimum(a, b) / np.maximum(a, b) < tau
        shared = near0[:, :, None] == near1[:, None, :]
        cost = np.zeros(len(x0))
        for scale, size in enumerate((K + 2, K, K - 2)):
            ring = slice(1 + scale, K + 3 - scale)
            common = shared[:, ring, ring].any(-1)
            cost += (size - common.sum(-1) + (common & differs[:, ring]).sum(-1)) / size
        kept = cost / 3 <= threshold
    return kept


def _milliseconds(function: Callable[[], Any]) -> float:
    start = time.process_time()
    function()
    return 1e3 * (time.process_time() - start)


def _line(what: str, n: int, pairs: int, ours: list[float], peer: str, theirs: list[float]) -> dict[str, Any]:
    line = {"": what, "matches": n, "pairs a call": pairs, "fmtorch, least": f"{min(ours):.2f}"}
    line |= {
        "fmtorch, median": f"{np.median(ours):.2f}",
        "peer": peer,
        "peer, least": "",
        "peer, median": "",
        "ratio": "",
    }
    if theirs:
        line |= {"peer, least": f"{min(theirs):.2f}", "peer, median": f"{np.median(theirs):.2f}"}
        line["ratio"] = f"{np.median(np.array(ours) / np.array(theirs)):.2f}"
    return line
