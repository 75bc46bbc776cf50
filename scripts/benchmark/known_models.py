"""COLMAP models of scenes whose cameras are known: SIFT matches of all pairs, triangulated with these cameras.

python -m scripts.benchmark known_models --root DATA/Strecha --folder models

A scene in FM-Bench's layout, with Camera.txt, becomes ``models/<scene>`` with sparse/ and images/, for dataset=colmap.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from scipy.spatial.transform import Rotation

from scripts.benchmark.verify_scenes import ORIGIN, Scene, calibrate, extract, read_scene


def add_arguments(commands: Any) -> None:
    parser = commands.add_parser("known_models", help=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, nargs="+", required=True, help="folders of scenes in FM-Bench's layout")
    parser.add_argument("--folder", type=Path, default=Path("models"), help="of the models; those there are kept")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    for path in (file.parent for root in arguments.root for file in sorted(root.glob("*/Camera.txt"))):
        target = arguments.folder / path.name
        if not target.is_dir():
            points, observations = triangulate(read_scene(path), target)
            Console().print(f"{target}: {points} points, {observations:.0f} seen in an image")


def triangulate(scene: Scene, target: Path) -> tuple[int, float]:
    """Write the model of a scene; returns the number of points and how many an image sees on average."""
    import pycolmap

    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as temporary:
        folder = Path(temporary) / "scene"
        sparse, database = folder / "sparse", Path(temporary) / "database.db"
        sparse.mkdir(parents=True)
        extract(scene, database)
        calibrate(database, scene.truth)
        pycolmap.match_exhaustive(
            database, matching_options=pycolmap.FeatureMatchingOptions(num_threads=1), device=pycolmap.Device.cpu
        )
        write_cameras(scene, database, sparse)
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0, extract_colors=False)
        model = pycolmap.triangulate_points(
            pycolmap.Reconstruction(sparse), database, scene.images, sparse, refine_intrinsics=False, options=options
        )
        for file in sparse.iterdir():
            file.unlink()
        model.write_text(sparse)
        shutil.copytree(scene.images, folder / "images")
        folder.rename(target)
    return model.num_points3D(), model.compute_mean_observations_per_reg_image()


def write_cameras(scene: Scene, database: Path, folder: Path) -> None:
    """A text model of the true cameras, with the numbers that images have in a database, and without points."""
    import pycolmap

    cameras, images = list[str](), list[str]()
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            camera = opened.read_camera(image.camera_id)
            K, R, t = (part[image.name] for part in scene.truth)
            values = [K[0, 0], K[1, 1], K[0, 2] + ORIGIN, K[1, 2] + ORIGIN]
            size = f"{camera.width} {camera.height}"
            cameras.append(f"{image.camera_id} PINHOLE {size} {' '.join(map(repr, map(float, values)))}")
            pose = [*Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]], *t]
            place = f"{image.camera_id} {image.name}"
            images += [f"{image.image_id} {' '.join(map(repr, map(float, pose)))} {place}", ""]
    for name, lines in (("cameras.txt", dict.fromkeys(cameras)), ("images.txt", images), ("points3D.txt", [])):
        (folder / name).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
