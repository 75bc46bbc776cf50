"""Pose, focal lengths and F by what is known of the cameras, beside PoseLib, COLMAP, OpenCV, kornia and SupeRANSAC.

A method is named as NAME:LEVEL[:KEY=VALUE,...]. Levels: known; rough (each focal length times a log-uniform factor of
its own, 1/1.1 to 1.1, given with a deviation of 6 %); wrong (1.5 times too long, given as rough); one_sided (K0 alone);
shared (one unknown focal length; of pairs of one camera alone); unknown. Peers take a calibration for exact. All
methods get the same SIFT matches; P(inlier) and noise from the keypoints' frames are part of ours, and of its time. One
thread; the methods take turns at each pair.

python -m scripts.benchmark cameras --root DATA/Strecha --root DATA/PhotoTourism --root DATA/KITTI --root DATA/TUM \\
    --specs scripts/benchmark/cameras.txt --seeds 3 --rows rows.jsonl --update docs/appendix/cameras.md
python -m scripts.benchmark cameras --root DATA/Strecha_train --root DATA/TanksLike --methods fmtorch:known

The second command is of the scenes that thresholds are chosen on. --rows is appended to pair by pair: started again,
the command measures what is missing.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from rich.progress import track

from fmtorch import metrics
from fmtorch.data import ImagePair
from scripts.benchmark import cameras_table, matched
from scripts.benchmark.cameras_knowledge import Answer, Knowledge, applies, knowledge
from scripts.benchmark.cameras_methods import Solver, build, identity, read
from scripts.benchmark.kept import Kept, Row
from scripts.benchmark.matched import Item, console
from scripts.benchmark.specs import read_specs

Measured = dict[str, list[Row]]  # the rows of each method
FAILED = {"rotation": 180.0, "translation": 90.0, "flipped": False, "posed": False}


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("cameras", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    matched.add_arguments(parser)
    parser.add_argument("--methods", nargs="+", default=[], help="NAME:LEVEL[:KEY=VALUE,...]")
    parser.add_argument("--specs", type=Path, help="a file with one method a line; # starts a comment")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rows", type=Path, help="keep what each method makes of each pair here, one line each")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--update", type=Path, help="write the tables into this Markdown file, between its markers")
    parser.add_argument("--marker", default="cameras", help="the tables go between <!-- NAME --> and <!-- end NAME -->")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    kept = Kept(arguments.rows)
    methods = [*arguments.methods, *(read_specs(arguments.specs) if arguments.specs else [])]
    if not methods:
        raise SystemExit("name at least one method: --methods or --specs")
    solvers = {text: build(text) for text in methods}
    items = [(pair, c) for pair, c in matched.load(arguments) if has_cameras(pair)]
    if not items:
        raise SystemExit("no pair has cameras; a --root must hold Camera.txt files")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = measure(solvers, items, arguments.seeds, kept, matched.identity(arguments))
    pairs = [pair for pair, _ in items]
    figures = cameras_table.figures(rows, pairs)
    for sheet in cameras_table.sheets(figures, pairs, arguments.seeds):
        console.print(sheet.terminal())
    if arguments.json:
        machine = {"processor": platform.processor() or platform.machine(), "torch": torch.__version__}
        content = {"machine": machine, "pairs": len(pairs), "seeds": arguments.seeds, "figures": figures}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n")
    if arguments.update:
        cameras_table.write(arguments.update, arguments.marker, figures, pairs, arguments.seeds)


def has_cameras(pair: ImagePair) -> bool:
    """Whether the cameras of a pair are known."""
    return all(value is not None for value in (pair.K0, pair.K1, pair.R, pair.t))


def measure(solvers: dict[str, Solver], items: list[Item], seeds: int, kept: Kept, matches: str = "") -> Measured:
    """The rows of each method, one for each pair and seed that its level applies to, by seed and pair.

    Args:
        solvers: the methods by their names.
        items: pairs whose cameras are known, with their matches.
        seeds: how many, from 0.
        kept: takes the rows; those that it has are not measured again.
        matches: the digest of what the matches were made with.
    """
    done = kept.by("pair", "seed", "method", "identity", "matches")
    made_with = {text: (text, identity(text), matches) for text in solvers}
    rows: Measured = {text: [] for text in solvers}
    started = set[str]()
    turns = [(seed, item) for seed in range(seeds) for item in items]
    for seed, (pair, c) in track(turns, "estimating", console=console, transient=True):
        new = []
        for text, solve in solvers.items():
            if not applies(read(text).level, pair):
                continue
            row = done.get((pair.identity, seed, *made_with[text]))
            if row is None:
                given = knowledge(read(text).level, pair, _sizes((pair, c)), seed)
                if text not in started:
                    solve(c, given, seed)  # not counted: lazy initialisation
                    started.add(text)
                row = judge(solve, (pair, c), given, seed)
                row |= dict(zip(("method", "identity", "matches"), made_with[text], strict=True))
                new.append(row)
            rows[text].append(row)
        kept.add(new)
    return rows


def judge(solve: Solver, item: Item, given: Knowledge, seed: int) -> Row:
    """What one call makes of a pair: angles in degrees, NSGD, relative errors of focal lengths, milliseconds.

    A pair without a pose has the largest angles and is not `posed`. `flipped`: the translation points backwards, which
    its angle, folded to 90 degrees, does not tell. Focal lengths that are given exactly have no error; those of a
    method that keeps what it is given are these.
    """
    pair, c = item
    start = time.process_time()
    result = solve(c, given, seed)
    ms = 1e3 * (time.process_time() - start)
    row: Row = {"pair": pair.identity, "seed": seed, "ms": ms, "nsgd": 1.0, **FAILED, **_pose(result, pair)}
    if result.F is not None and np.isfinite(result.F).all() and np.any(result.F):
        F = torch.from_numpy(result.F / np.linalg.norm(result.F))[None]
        assert c.size0 is not None
        assert c.size1 is not None
        row["nsgd"] = float(metrics.nsgd(torch.from_numpy(pair.F)[None], F, c.size0, c.size1, key=c.keys))
    exact = [K is not None and not given.deviation for K in (given.K0, given.K1)]
    if not all(exact):
        focals = given.focals if result.focals is None else result.focals
        errors = np.abs(focals / knowledge("known", pair, _sizes(item), seed).focals - 1)
        wrong = np.where(np.isfinite(errors), errors, 1.0)  # a pair without focal lengths misses them
        row["focals"] = [float(error) for error, known in zip(wrong, exact, strict=True) if not known]
    return row


def _pose(result: Answer, pair: ImagePair) -> dict[str, Any]:
    """The angles of an answer's pose, nothing where it has none."""
    if result.R is None or result.t is None or not (np.isfinite(result.R).all() and np.isfinite(result.t).all()):
        return {}
    R, t, R_true, t_true = (torch.from_numpy(np.array(v, np.float64)) for v in (result.R, result.t, pair.R, pair.t))
    folded = metrics.pose_error(R, t, R_true, t_true)
    return {
        "rotation": float(folded.rotation), "translation": float(folded.translation),
        "flipped": bool(t @ t_true < 0), "posed": True,
    }  # fmt: skip


def _sizes(item: Item) -> Any:
    """The sizes of both images (2, 2), as (h, w)."""
    _, c = item
    assert c.size0 is not None
    assert c.size1 is not None
    return np.stack([c.size0[0].numpy(), c.size1[0].numpy()])
