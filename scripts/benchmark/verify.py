"""COLMAP databases verified by COLMAP and by ours, and what COLMAP's mappers make of either.

Features and matches are those of COLMAP's SIFT, or of our default pipeline, made once for each scene in --work. Every
method begins with the same database without geometries, on one thread, reading and writing included: `colmap:PX` is
`pycolmap.geometric_verification` at that threshold, `ours` is `fmtorch.verify`. Known cameras are the true ones, with
a prior focal length. Then the incremental and the global mapper, whose poses are compared with the true ones; images
that are not registered count as wrong. Rows are kept in --work: an interrupted run goes on where it stopped.

python -m scripts.benchmark verify --root DATA --work runs/verify --markdown docs/appendix/verify.md
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import time
from pathlib import Path
from typing import Any

import torch

import fmtorch
from fmtorch.estimators.external import colmap
from scripts.benchmark.kept import Kept, Row
from scripts.benchmark.matched import console
from scripts.benchmark.sheet import put
from scripts.benchmark.verify_mappers import MAPPERS, mapped, pair_poses
from scripts.benchmark.verify_scenes import CAMERA_KINDS, FEATURE_KINDS, Scene, database_of, read_scene
from scripts.benchmark.verify_table import sheets

SCENES = (
    "Strecha/Herz-Jesus-P8", "PhotoTourism/sacre_coeur", "Strecha/fountain-P11", "Strecha_train/castle-P19",
    "TanksLike/fox",
)  # fmt: skip
METHODS = ("colmap:4", "colmap:1", "colmap:0.5", "ours")
FIELDS = ("scene", "features", "cameras", "method", "seed", "mapper")  # what a row is of; no mapper: verification


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("verify", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="a folder of data sets in FM-Bench's layout")
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="folders below it")
    parser.add_argument("--work", type=Path, required=True, help="a folder for databases and rows")
    parser.add_argument("--methods", nargs="+", default=METHODS, help="colmap:PX, or ours")
    parser.add_argument("--features", nargs="+", default=FEATURE_KINDS, choices=FEATURE_KINDS)
    parser.add_argument("--cameras", nargs="+", default=CAMERA_KINDS, choices=CAMERA_KINDS)
    parser.add_argument("--mappers", nargs="*", default=MAPPERS, choices=MAPPERS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--markdown", type=Path, help="put the tables between the marks of this file")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    arguments.work.mkdir(parents=True, exist_ok=True)
    kept = Kept(arguments.work / "rows.jsonl")
    for name in arguments.scenes:
        scene = read_scene(arguments.root / name)
        kinds = itertools.product(arguments.features, arguments.cameras)
        # Our features are shown once, with unknown cameras.
        for features, cameras in ((f, c) for f, c in kinds if f == "colmap" or c == "unknown"):
            database = database_of(scene, features, cameras, arguments.work)
            for seed, method in itertools.product(range(arguments.seeds), arguments.methods):
                measure(scene, database, (scene.name, features, cameras, method, seed), arguments.mappers, kept)
    tables = sheets(kept.rows, arguments.methods)
    for table in tables:
        console.print(table.terminal())
    if arguments.markdown is not None:
        put(arguments.markdown, tables)


def measure(scene: Scene, database: Path, key: tuple[Any, ...], mappers: list[str], kept: Kept) -> None:
    """One verification, and what the mappers make of it, as far as there are no rows yet."""
    done = kept.by(*FIELDS)
    missing = [mapper for mapper in ("", *mappers) if (*key, mapper) not in done]
    if not missing:
        return
    _, _, cameras, method, seed = key
    path = database.with_name(f"{database.stem}-{method.replace(':', '-')}-{seed}.db")
    remove(path)
    shutil.copy(database, path)
    row = verified_by(method, path, seed)
    if "" in missing:
        kept.add([_row(key, "", row | pair_poses(path, scene.truth))])
    for mapper in missing:
        if mapper:
            kept.add([_row(key, mapper, mapped(mapper, path, scene, cameras, seed))])
    remove(path)


def _row(key: tuple[Any, ...], mapper: str, figures: Row) -> Row:
    return dict(zip(FIELDS, (*key, mapper), strict=True)) | figures


def remove(path: Path) -> None:
    """Remove a database with what lies beside it."""
    for old in path.parent.glob(f"{path.name}*"):
        old.unlink()


def verified_by(method: str, path: Path, seed: int) -> Row:
    """Verify a database in place: pairs, those with a geometry, and processor seconds."""
    import pycolmap

    kind, _, threshold = method.partition(":")
    if kind == "ours":
        _load_kernels(path)
        start = time.process_time()
        fmtorch.verify(path, seed=seed)
        seconds = time.process_time() - start
    else:
        options = colmap.two_view_options(float(threshold), seed)
        verifier = pycolmap.GeometricVerifierOptions(num_threads=1)
        start = time.process_time()
        pycolmap.geometric_verification(path, verifier_options=verifier, two_view_geometry_options=options)
        seconds = time.process_time() - start
    with pycolmap.Database.open(path) as database:
        pairs, verified = len(database.read_num_matches()[0]), len(database.read_two_view_geometry_num_inliers()[0])
    return {"pairs": pairs, "verified": verified, "seconds": seconds}


def _load_kernels(path: Path) -> None:
    """One untimed verification a process: what it loads and compiles is no part of a pair's time."""
    if path.parent in _warm:
        return
    copy = path.with_suffix(".warm")
    fmtorch.verify(path, output=copy, force=True)
    remove(copy)
    _warm.add(path.parent)


_warm: set[Path] = set()
