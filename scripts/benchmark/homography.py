"""Homographies of photographs as planes: errors and milliseconds beside PoseLib and OpenCV, on the same matches.

Warped: each photograph is seen as a plane, tilted by 20 to 55 degrees over another photograph, with blur and noise.
Hard pairs keep at most 60 of their right matches and 70 % random ones. Views: two pictures of the plane, each rendered
by a camera and under light of its own (`training.planes`). SIFT, ratio 0.8, one match a location, P(inlier) from frame
consistency. Every second photograph is for tuning (--tuning), the others for the claim; --warps pairs are made of each.

The error of a pair is the mean distance of the true and the estimated image of the photograph's corners, or, of views,
of the points of a grid that both see.

python -m scripts.benchmark homography --photographs DATA/photos --seeds 3 --warps 2
python -m scripts.benchmark homography --photographs DATA/photos --tuning --methods ours:select.scale=0.5 poselib:2
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table

from fmtorch import find_homography, presets
from fmtorch.core.types import Correspondences
from fmtorch.evaluation.statistics import bootstrap_mean
from scripts.benchmark.homography_pairs import Case, hard, mapped, points, views, warped
from scripts.benchmark.matched import console

Array = NDArray[Any]
Solver = Callable[[Correspondences, int], Array | None]
WARP = 1000  # between the seeds of two warps of a photograph
THRESHOLDS = (1, 3, 5)  # px
METHODS = ("ours", "poselib:1", "poselib:2", "poselib:3", "usac_accurate:1", "usac_magsac:0.5")
KINDS = ("warped", "hard", "views")


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("homography", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=Path, required=True, help="a folder of photographs")
    parser.add_argument("--tuning", action="store_true", help="the photographs for choosing constants")
    parser.add_argument("--methods", nargs="+", default=METHODS, help="NAME:THRESHOLD or ours:KEY=VALUE,...")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--warps", type=int, default=1, help="pairs of each kind and photograph")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--limit", type=int, help="photographs at most")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    paths = sorted(p for p in arguments.photographs.iterdir() if p.suffix in (".jpg", ".png"))
    paths = paths[(0 if arguments.tuning else 1) :: 2][: arguments.limit]
    cases: dict[str, list[Case]] = {}
    if {"warped", "hard"} & set(arguments.kinds):
        numbered = [(i + WARP * k, path) for k in range(arguments.warps) for i, path in enumerate(paths)]
        pairs = ((seed, path, paths[(seed % WARP + 7) % len(paths)]) for seed, path in numbered)
        progress = track(pairs, "warping", len(numbered), console=console)
        cases["warped"] = [warped(path, behind, seed) for seed, path, behind in progress]
        cases["hard"] = [hard(case, seed) for case, (seed, _) in zip(cases["warped"], numbered, strict=True)]
    if "views" in arguments.kinds:
        cases["views"] = views(paths, arguments.warps)
    for kind in arguments.kinds:
        report(kind, {m: measure(solver(m), cases[kind], arguments.seeds) for m in arguments.methods}, cases[kind])


def solver(method: str) -> Solver:
    name, _, setting = method.partition(":")
    if name == "ours":
        return functools.partial(_ours, options_of(setting))
    if name == "poselib":
        return functools.partial(_poselib, float(setting))
    return functools.partial(_opencv, getattr(cv2, name.upper()), float(setting))


def options_of(setting: str) -> dict[str, Any]:
    """``select.scale=1.0,pool=6`` as ``{"select": {"scale": 1.0}, "pool": 6}``, into a preset's own mappings."""
    options: dict[str, Any] = {}
    for part in filter(None, setting.split(",")):
        key, value = part.split("=")
        group, _, option = key.rpartition(".")
        if group and group not in options:
            options[group] = dict(presets.load("estimator", "homography")[group])
        (options[group] if group else options)[option] = _value(value)
    return options


def _value(text: str) -> Any:
    """A number, or a name."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _ours(options: dict[str, Any], c: Correspondences, seed: int) -> Array | None:
    estimate = find_homography(
        c.x0, c.x1, mask=c.mask, quality=c.quality, prior=c.prior, noise=c.noise, key=c.key, seed=seed, **options
    )
    return estimate.H[0].numpy() if bool(estimate.ok[0]) else None


def _poselib(threshold: float, c: Correspondences, seed: int) -> Array | None:
    import poselib

    x0, x1 = points(c)
    H, _ = poselib.estimate_homography(x0, x1, {"max_reproj_error": threshold, "seed": seed}, {})
    return np.asarray(H)


def _opencv(method: int, threshold: float, c: Correspondences, seed: int) -> Array | None:
    cv2.setRNGSeed(seed)
    x0, x1 = points(c)
    if len(x0) < 4:
        return None
    H, _ = cv2.findHomography(x0, x1, method, threshold, maxIters=2000, confidence=0.9999)
    return None if H is None else np.asarray(H)


def measure(solve: Solver, cases: list[Case], seeds: int) -> tuple[Array, Array]:
    """Errors in pixels, and milliseconds, (seeds, pairs)."""
    solve(cases[0].matches, 0)
    errors, ms = np.full((seeds, len(cases)), np.inf), np.zeros((seeds, len(cases)))
    for seed in range(seeds):
        for i, case in enumerate(cases):
            start = time.process_time()
            H = solve(case.matches, seed)
            ms[seed, i] = (time.process_time() - start) * 1e3
            if H is not None:
                apart = np.linalg.norm(mapped(H, case.points) - mapped(case.H, case.points), axis=1)
                errors[seed, i] = float(apart.mean())
    return errors, ms


def report(kind: str, results: dict[str, tuple[Array, Array]], cases: list[Case]) -> None:
    names = [case.name for case in cases]
    seeds = len(next(iter(results.values()))[0])
    table = Table(title=f"{kind}: {len(names)} pairs of {len(set(names))} photographs, {seeds} seeds")
    for column in ("method", *(f"AUC@{t} px" for t in THRESHOLDS), "first minus this at 1 px", "ms"):
        table.add_column(column, justify="left" if column == "method" else "right")
    areas = {m: [np.clip(1 - errors / t, 0, 1).mean(0) * 100 for t in THRESHOLDS] for m, (errors, _) in results.items()}
    first = next(iter(areas.values()))
    for method, of_thresholds in areas.items():
        lead = bootstrap_mean(first[0] - of_thresholds[0], names)
        figures = [f"{bootstrap_mean(a, names).value:.1f}" for a in of_thresholds]
        table.add_row(method, *figures, f"{lead:+.1f}", f"{np.median(results[method][1]):.2f}")
    console.print(table)
