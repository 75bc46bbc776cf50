"""Exhaustive two-nearest-neighbour matching against OpenCV's brute-force matcher, one thread each."""

from __future__ import annotations

import argparse
import time
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console

from fmtorch.matching import nearest_neighbors


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("matching", help=__doc__)
    parser.add_argument("--features", type=int, nargs="+", default=[2000, 5000, 8000])
    parser.add_argument("--repeats", type=int, default=5)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for n in arguments.features:
        # SIFT-like: non-negative integers, norm about 512
        rng = np.random.default_rng(0)
        d0, d1 = (np.minimum(rng.gamma(0.6, 45, (n, 128)), 255).round().astype(np.float32) for _ in range(2))
        t0, t1 = torch.from_numpy(d0), torch.from_numpy(d1)
        brute_force = cv2.BFMatcher(cv2.NORM_L2)
        own, peer = [], []
        for _ in range(arguments.repeats):
            start = time.perf_counter()
            nearest_neighbors(t0, t1)
            middle = time.perf_counter()
            brute_force.knnMatch(d0, d1, k=2)
            own.append(1e3 * (middle - start))
            peer.append(1e3 * (time.perf_counter() - middle))
        ratio = np.median(np.array(own) / np.array(peer))
        times = f"{np.median(own):.0f} ms, OpenCV {np.median(peer):.0f} ms, ratio {ratio:.2f}"
        Console().print(f"{n} x {n} x 128: {times} (medians of {arguments.repeats})")
