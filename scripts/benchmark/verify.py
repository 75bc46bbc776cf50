"""COLMAP's databases verified by COLMAP and by ours, and what its incremental mapper makes of either.

Features and matches are those of COLMAP's SIFT on one thread, made once for each scene in --work. Every method begins
with the same database without geometries, on one thread, reading and writing included: `colmap:PX` is
`pycolmap.verify_matches` at that threshold, `ours:CAMERAS` is `fmtorch.verify`. A scene is a folder of photographs, or
one with `Images` and perhaps a `Camera.txt` (the layout of FM-Bench); with it the errors of all relative poses are
known, where images that are not registered count as wrong.

python -m scripts.benchmark verify --scenes DATA/Strecha_train/castle-P19 DATA/TanksLike/fox --work runs/verify
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import shutil
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.table import Table

import fmtorch
from fmtorch.metrics import pose_auc, pose_error
from scripts.benchmark.matched import console

METHODS = ("colmap:4", "colmap:1", "ours:stored")
THRESHOLDS = (1, 5, 10)  # degrees
RIGHT, WRONG = 5, 10  # degrees, of the pose of a pair
FEATURES = 4096
MIN_MODEL = 3  # images


class Poses(NamedTuple):
    """World to camera of images by name."""

    R: dict[str, NDArray[np.float64]]
    t: dict[str, NDArray[np.float64]]


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("verify", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", required=True, help="folders of photographs")
    parser.add_argument("--work", type=Path, required=True, help="a folder for databases and models")
    parser.add_argument("--methods", nargs="+", default=METHODS, help="colmap:PX, or ours:stored|shared|unknown")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3, help="verifications, of which the fastest counts")
    parser.add_argument("--no-mapper", action="store_true", help="verify only")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    table = Table(title="one thread")
    columns = (
        "scene",
        "method",
        "pairs",
        "verified",
        "ms/pair",
        "pairs/s",
        "registered",
        "points",
        "track",
        "error px",
    )
    for column in (*columns, *(f"AUC@{limit}" for limit in THRESHOLDS), "mapper s"):
        table.add_column(column, justify="left" if column in columns[:2] else "right")
    arguments.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for folder in arguments.scenes:
        images = folder / "Images" if (folder / "Images").is_dir() else folder
        database = matched(images, arguments.work / f"{folder.name}.db")
        truth = true_poses(folder)
        for method, seed in itertools.product(arguments.methods, range(arguments.seeds)):
            row = measured(method, seed, database, images, truth, arguments)
            rows.append({"scene": folder.name, "method": method, "seed": seed, **row})
            with (arguments.work / "rows.jsonl").open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
        for method in arguments.methods:
            mine = [row for row in rows if row["scene"] == folder.name and row["method"] == method]
            table.add_row(folder.name, method, *cells(mine))
    console.print(table)


def cells(rows: list[dict[str, Any]]) -> list[str]:
    """The means of the seeds."""
    digits = {
        "pairs": 0,
        "verified": 0,
        "ms": 2,
        "rate": 0,
        "poses": 0,
        "right": 0,
        "wrong": 0,
        "registered": 1,
        "points": 0,
        "track": 2,
        "error": 3,
    }
    digits |= {f"auc{limit}": 1 for limit in THRESHOLDS} | {"mapper": 1}
    means = {name: float(np.mean([row.get(name, math.nan) for row in rows])) for name in digits}
    return ["" if math.isnan(means[name]) else f"{means[name]:,.{n}f}" for name, n in digits.items()]


def matched(images: Path, path: Path) -> Path:
    """The database of COLMAP's SIFT and all pairs' matches, without geometries; one camera for all photographs."""
    import pycolmap

    if path.exists():
        return path
    begun = path.with_suffix(".begun")
    begun.unlink(missing_ok=True)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    extraction.sift.max_num_features = FEATURES
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, skip_geometric_verification=True)
    single, cpu = pycolmap.CameraMode.SINGLE, pycolmap.Device.cpu
    pycolmap.extract_features(begun, images, camera_mode=single, extraction_options=extraction, device=cpu)
    pycolmap.match_exhaustive(begun, matching_options=matching, device=cpu)
    return begun.rename(path)


def true_poses(folder: Path) -> Poses | None:
    """Those of `Camera.txt`: K, R and t of each image in a line."""
    if not (folder / "Camera.txt").exists():
        return None
    lines = np.loadtxt(folder / "Camera.txt").reshape(-1, 21)
    names = sorted(path.name for path in (folder / "Images").iterdir())
    R = {name: line[9:18].reshape(3, 3) for name, line in zip(names, lines, strict=True)}
    return Poses(R, {name: line[18:] for name, line in zip(names, lines, strict=True)})


def measured(
    method: str, seed: int, database: Path, images: Path, truth: Poses | None, arguments: argparse.Namespace
) -> dict[str, Any]:
    """One verification, timed, and what the mapper makes of it."""
    path, seconds = arguments.work / f"{database.stem}-{method.replace(':', '-')}-{seed}.db", math.inf
    for _ in range(arguments.repeats):
        for old in path.parent.glob(f"{path.name}*"):
            old.unlink()
        shutil.copy(database, path)
        seconds = min(seconds, verified_by(method, path, seed))
    pairs, verified = counts(path)
    row = {"pairs": pairs, "verified": verified, "ms": 1000 * seconds / pairs, "rate": pairs / seconds}
    row |= {} if truth is None else two_view_poses(path, truth)
    return row if arguments.no_mapper else row | mapped(path, images, truth, seed)


def verified_by(method: str, path: Path, seed: int) -> float:
    """Verify a database in place; processor seconds."""
    import pycolmap

    kind, _, value = method.partition(":")
    if kind == "ours":
        start = time.process_time()
        fmtorch.verify(path, cameras=value or "stored", seed=seed)
        return time.process_time() - start
    options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
    options.ransac.max_error, options.ransac.random_seed = float(value), seed
    verifier = pycolmap.GeometricVerifierOptions(num_threads=1)
    start = time.process_time()
    pycolmap.geometric_verification(path, verifier_options=verifier, two_view_geometry_options=options)
    return time.process_time() - start


def counts(path: Path) -> tuple[int, int]:
    """Pairs with matches, and those with a geometry."""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        return len(database.read_num_matches()[0]), len(database.read_two_view_geometry_num_inliers()[0])


def two_view_poses(path: Path, truth: Poses) -> dict[str, int]:
    """How many pairs have a relative pose, and how many of them are right within 5 degrees, or off by more than 10."""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        ends = [pycolmap.pair_id_to_image_pair(pair) for pair in database.read_two_view_geometries()[0]]
        poses = [database.read_two_view_geometry(*pair).cam2_from_cam1 for pair in ends]
    errors = np.array([
        _error(pose, truth, names[pair[0]], names[pair[1]])
        for pose, pair in zip(poses, ends, strict=True) if pose is not None
    ])  # fmt: skip
    return {"poses": len(errors), "right": int((errors < RIGHT).sum()), "wrong": int((errors > WRONG).sum())}


def mapped(path: Path, images: Path, truth: Poses | None, seed: int) -> dict[str, Any]:
    """The largest model of COLMAP's incremental mapper."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=MIN_MODEL, num_threads=1, random_seed=seed, extract_colors=False
    )
    output = path.with_suffix(".model")
    output.mkdir(exist_ok=True)
    start = time.process_time()
    models = pycolmap.incremental_mapping(path, images, output, options)
    seconds = time.process_time() - start
    if not models:
        return {"registered": 0, "mapper": seconds}
    model = max(models.values(), key=lambda each: each.num_reg_images())
    row = {
        "registered": model.num_reg_images(), "points": model.num_points3D(), "mapper": seconds,
        "track": model.compute_mean_track_length(), "error": model.compute_mean_reprojection_error(),
    }  # fmt: skip
    return row if truth is None else row | accuracy(model, truth)


def accuracy(model: Any, truth: Poses) -> dict[str, float]:
    """AUC, per cent, of the errors of all relative poses: the larger of both angles."""
    poses = {image.name: image.cam_from_world() for image in model.images.values() if image.has_pose}
    errors = [
        _error(poses[b] * poses[a].inverse(), truth, a, b) if a in poses and b in poses else 180.0
        for a, b in itertools.combinations(sorted(truth.R), 2)
    ]
    areas = pose_auc(torch.tensor(errors, dtype=torch.float64), THRESHOLDS).tolist()
    return {f"auc{limit}": 100 * area for limit, area in zip(THRESHOLDS, areas, strict=True)}


def _error(relative: Any, truth: Poses, a: str, b: str) -> float:
    """The larger of the errors of rotation and direction of translation, in degrees."""
    R = truth.R[b] @ truth.R[a].T
    t = truth.t[b] - R @ truth.t[a]
    given = [torch.tensor(np.array(value)) for value in (relative.rotation.matrix(), relative.translation, R, t)]
    return float(max(pose_error(*given, up_to_sign=False)))
