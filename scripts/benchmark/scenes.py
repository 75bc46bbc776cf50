"""Scenes with true cameras, as COLMAP databases without two-view geometries and as COLMAP models."""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scripts.benchmark.runner import add_command

FEATURES = 4096
ORIGIN = 0.5  # px: COLMAP's coordinates of the first pixel's centre
FEATURE_KINDS = ("colmap", "ours")  # COLMAP's SIFT; our default pipeline
CAMERA_KINDS = ("unknown", "known")
KNOWN_MODELS = """COLMAP models of scenes in FM-Bench's layout: SIFT matches triangulated with the known cameras.

A scene becomes ``models/<scene>`` with sparse/ and images/, for dataset=colmap.
"""
Array = NDArray[np.float64]


def add_arguments(commands: Any) -> None:
    parser = add_command(commands, "known_models", run_known_models, KNOWN_MODELS)
    parser.add_argument("--root", type=Path, nargs="+", required=True, help="folders of scenes in FM-Bench's layout")
    parser.add_argument("--folder", type=Path, default=Path("models"), help="of the models; those there are kept")


class Truth(NamedTuple):
    """Calibration and pose, world to camera, of images by name."""

    K: dict[str, Array]
    R: dict[str, Array]
    t: dict[str, Array]


class Scene(NamedTuple):
    """A folder of photographs with true cameras. single: whether one camera took them all."""

    name: str
    images: Path
    truth: Truth
    single: bool


def read_scene(folder: Path) -> Scene:
    """FM-Bench's layout: `Images`, and `Camera.txt` with K, R and t of each image in a line.

    Raises SystemExit where one of them is missing.
    """
    if not (folder / "Images").is_dir() or not (folder / "Camera.txt").is_file():
        raise SystemExit(f"{folder} holds no Images and Camera.txt; give scenes in FM-Bench's layout")
    lines = np.loadtxt(folder / "Camera.txt").reshape(-1, 21)
    named = list(zip(sorted(path.name for path in (folder / "Images").iterdir()), lines, strict=True))
    K, R = ({name: line[i : i + 9].reshape(3, 3) for name, line in named} for i in (0, 9))
    truth = Truth(K, R, {name: line[18:] for name, line in named})
    return Scene(folder.name, folder / "Images", truth, bool((lines[:, :9] == lines[0, :9]).all()))


def remove(path: Path) -> None:
    """Remove a database with what lies beside it."""
    for old in path.parent.glob(f"{path.name}*"):
        old.unlink()


def database_of(scene: Scene, features: str, cameras: str, work: Path) -> Path:
    """The database of all pairs' matches without geometries, made at most once in `work`.

    cameras: "unknown", COLMAP's guess of a SIMPLE_RADIAL, or "known", the true PINHOLE with a prior focal length.
    """
    path = work / f"{scene.name}-{features}-{cameras}.db"
    if path.exists():
        return path
    begun = path.with_suffix(".begun")
    begun.unlink(missing_ok=True)
    if cameras == "known":
        shutil.copy(database_of(scene, features, "unknown", work), begun)
        calibrate(begun, scene.truth)
    elif features == "colmap":
        match(scene, begun, verified=False)
    else:
        _match_by_ours(scene, begun, work)
    return begun.rename(path)


def match(scene: Scene, path: Path, verified: bool) -> None:
    """COLMAP's SIFT of a scene and its matches of all pairs, in a new database; verified: by the true cameras."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    extraction.sift.max_num_features = FEATURES
    mode = pycolmap.CameraMode.SINGLE if scene.single else pycolmap.CameraMode.PER_IMAGE
    cpu = pycolmap.Device.cpu
    pycolmap.extract_features(path, scene.images, camera_mode=mode, extraction_options=extraction, device=cpu)
    if verified:
        calibrate(path, scene.truth)
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, skip_geometric_verification=not verified)
    pycolmap.match_exhaustive(path, matching_options=matching, device=cpu)


def _match_by_ours(scene: Scene, path: Path, work: Path) -> None:
    """`fmtorch match images=`, of which the geometries are removed again."""
    import pycolmap

    output, camera = work / f"{scene.name}-match", "shared" if scene.single else "per_image"
    words = [f"images={scene.images}", "export=colmap", f"camera={camera}", f"output={output}"]
    if subprocess.run([sys.executable, "-m", "fmtorch", "match", *words], check=False).returncode:
        raise SystemExit(f"{scene.images} could not be matched; see above")
    shutil.copy(output / "database.db", path)
    with pycolmap.Database.open(path) as database:
        database.clear_two_view_geometries()


def calibrate(path: Path, truth: Truth) -> None:
    """Replace the database's cameras by the true ones."""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        for image in database.read_all_images():
            K, camera = truth.K[image.name], database.read_camera(image.camera_id)
            params: list[Any] = [K[0, 0], K[1, 1], K[0, 2] + ORIGIN, K[1, 2] + ORIGIN]
            known = pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params)
            known.camera_id, known.has_prior_focal_length = image.camera_id, True
            database.update_camera(known)


def run_known_models(arguments: argparse.Namespace) -> None:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0, extract_colors=False)
    for path in (file.parent for root in arguments.root for file in sorted(root.glob("*/Camera.txt"))):
        target, scene = arguments.folder / path.name, read_scene(path)
        if target.is_dir():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as temporary:
            folder, database = Path(temporary) / "scene", Path(temporary) / "database.db"
            sparse = folder / "sparse"
            sparse.mkdir(parents=True)
            match(scene, database, verified=True)
            model = pycolmap.triangulate_points(
                posed(scene, database), database, scene.images, sparse, refine_intrinsics=False, options=options
            )
            for file in sparse.iterdir():
                file.unlink()
            model.write_text(sparse)
            shutil.copytree(scene.images, folder / "images")
            folder.rename(target)
        seen = model.compute_mean_observations_per_reg_image()
        print(f"{target}: {model.num_points3D()} points, {seen:.0f} seen in an image")


def posed(scene: Scene, database: Path) -> Any:
    """A reconstruction of the true cameras, with the numbers that images have in a database, and without points."""
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            if image.camera_id not in model.cameras:
                model.add_camera_with_trivial_rig(opened.read_camera(image.camera_id))
            rotation = pycolmap.Rotation3d(scene.truth.R[image.name])
            given = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(given, pycolmap.Rigid3d(rotation, scene.truth.t[image.name]))
    return model
