"""Scenes with true cameras, as COLMAP databases of features and matches without two-view geometries."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FEATURES = 4096
ORIGIN = 0.5  # px: COLMAP's coordinates of the first pixel's centre
FEATURE_KINDS = ("colmap", "ours")  # COLMAP's SIFT; our default pipeline
CAMERA_KINDS = ("unknown", "known")

Array = NDArray[np.float64]


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
    names = sorted(path.name for path in (folder / "Images").iterdir())
    named = list(zip(names, lines, strict=True))
    K, R = ({name: line[i : i + 9].reshape(3, 3) for name, line in named} for i in (0, 9))
    truth = Truth(K, R, {name: line[18:] for name, line in named})
    return Scene(folder.name, folder / "Images", truth, bool((lines[:, :9] == lines[0, :9]).all()))


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
        _match_by_colmap(scene, begun)
    else:
        _match_by_ours(scene, begun, work)
    return begun.rename(path)


def _match_by_colmap(scene: Scene, path: Path) -> None:
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions(num_threads=1, skip_geometric_verification=True)
    extract(scene, path)
    pycolmap.match_exhaustive(path, matching_options=matching, device=pycolmap.Device.cpu)


def extract(scene: Scene, path: Path) -> None:
    """COLMAP's SIFT of a scene's images, in a new database."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    extraction.sift.max_num_features = FEATURES
    mode = pycolmap.CameraMode.SINGLE if scene.single else pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        path, scene.images, camera_mode=mode, extraction_options=extraction, device=pycolmap.Device.cpu
    )


def _match_by_ours(scene: Scene, path: Path, work: Path) -> None:
    """`fmtorch match images=`, of which the geometries are removed again."""
    import pycolmap

    output, camera = work / f"{scene.name}-match", "shared" if scene.single else "per_image"
    words = [f"images={scene.images}", "export=colmap", f"camera={camera}", f"output={output}"]
    if subprocess.run([sys.executable, "-m", "fmtorch.match", *words], check=False).returncode:
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
