"""Exhaustive two-nearest-neighbour matching against OpenCV's brute-force matcher, one thread each."""

from __future__ import annotations

import argparse
import time
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from fmtorch.matching import nearest_neighbors

Descriptors = NDArray[np.float32]


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("matching", help=__doc__)
    parser.add_argument("--features", type=int, nargs="+", default=[2000, 5000, 8000])
    parser.add_argument("--repeats", type=int, default=5)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for n in arguments.features:
        for kind, make in KINDS.items():
            d0, d1 = make(0, n), make(1, n)
            compare(f"{n} x {n} x 128, {kind}", d0, d1, arguments.repeats)


def sift_like(seed: int, n: int) -> Descriptors:
    """Non-negative integers of norm about 512, as OpenCV's SIFT has them."""
    values = np.random.default_rng(seed).gamma(0.6, 45, (n, 128))
    return np.minimum(values, 255).round().astype(np.float32)


def rootsift_like(seed: int, n: int) -> Descriptors:
    """Square roots of histograms."""
    values = sift_like(seed, n)
    return np.asarray(np.sqrt(values / values.sum(1, keepdims=True)))


def unit(seed: int, n: int) -> Descriptors:
    """Directions at random, as far from one another as a network's descriptors ever are."""
    values = np.random.default_rng(seed).normal(size=(n, 128)).astype(np.float32)
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True))


KINDS = {"SIFT-like": sift_like, "RootSIFT-like": rootsift_like, "unit vectors": unit}


def compare(title: str, d0: Descriptors, d1: Descriptors, repeats: int) -> None:
    """Print the median seconds of processor time of both, and of their ratio, in turn."""
    t0, t1 = torch.from_numpy(d0), torch.from_numpy(d1)
    brute_force = cv2.BFMatcher(cv2.NORM_L2)
    nearest_neighbors(t0, t1)  # compiles
    own, peer = [], []
    for _ in range(repeats):
        start = time.process_time()
        nearest_neighbors(t0, t1)
        middle = time.process_time()
        brute_force.knnMatch(d0, d1, k=2)
        own.append(1e3 * (middle - start))
        peer.append(1e3 * (time.process_time() - middle))
    ratio = np.median(np.array(own) / np.array(peer))
    times = f"{np.median(own):.0f} ms, OpenCV {np.median(peer):.0f} ms, ratio {ratio:.2f}"
    Console().print(f"{title}: {times} (processor time, medians of {repeats})", highlight=False, soft_wrap=True)
