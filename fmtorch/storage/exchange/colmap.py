"""A COLMAP database of keypoints, matches and two-view geometries, written through pycolmap."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.lenses import MODELS
from fmtorch.storage.exchange.journal import ExportedImage, ExportedPair
from fmtorch.storage.exchange.two_view import ORIGIN, PairGeometry, two_view_geometry

FOCAL_LENGTH = 1.2  # of the longer side, where it is unknown: COLMAP's own default


def imported() -> ModuleType:
    """pycolmap. Raises ImportError naming the extra where it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError("pycolmap is not installed; pip install 'fmtorch[colmap]' brings it") from error
    module: ModuleType = pycolmap
    return module


def write_database(
    path: Path, images: Iterable[ExportedImage], pairs: Iterable[ExportedPair], shared_camera: bool = False
) -> None:
    """Write a database: keypoints, the matches given to the estimator, and the geometry of each pair with its inliers.

    Degenerate geometries are left out; a pair without a geometry has F, with both cameras known E, too, where its
    support is beyond chance. A known K is a PINHOLE camera with a trusted focal length, one with distortion is of its
    lens's model; images of equal cameras and size share it. Otherwise an image has a SIMPLE_RADIAL camera of the focal
    length of EXIF, or COLMAP's default, or shares it with all of its size. Pixels are moved by half of one, as COLMAP
    counts.
    """
    pycolmap = imported()
    cameras: dict[object, int] = {}
    ids: dict[str, int] = {}
    known: dict[str, NDArray[np.float64] | None] = {}
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database:
        for image in images:
            camera_id = _camera(pycolmap, database, cameras, image, shared_camera)
            entry = pycolmap.Image(name=image.name, camera_id=camera_id)
            ids[image.name] = entry.image_id = database.write_image(entry)
            known[image.name] = image.K
            frame = pycolmap.Frame(rig_id=camera_id)
            frame.add_data_id(entry.data_id)
            database.write_frame(frame)
            database.write_keypoints(ids[image.name], np.ascontiguousarray(image.points + np.float32(ORIGIN)))
        for pair in pairs:
            ends = ids[pair.name0], ids[pair.name1]
            matches = _one_to_one(pair)
            database.write_matches(*ends, np.ascontiguousarray(pair.matches[matches], np.uint32))
            geometry = _geometry(pair, pair.matches[matches], known)
            if geometry.kind != "degenerate":
                database.write_two_view_geometry(*ends, two_view_geometry(pycolmap, geometry))


def _camera(pycolmap: Any, database: Any, cameras: dict[object, int], image: ExportedImage, shared: bool) -> int:
    """The image's camera, with a rig of its own."""
    model, parameters, prior = _parameters(image)
    key: object = image.name
    if image.K is not None or image.lens is not None or shared:
        key = (image.size, model, *parameters)
    if key not in cameras:
        h, w = image.size
        camera = pycolmap.Camera(model=model, width=w, height=h, params=parameters)
        camera.has_prior_focal_length = prior
        camera.camera_id = cameras[key] = database.write_camera(camera)
        rig = pycolmap.Rig(rig_id=cameras[key])
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    return cameras[key]


def _parameters(image: ExportedImage) -> tuple[str, list[float], bool]:
    """The model of an image's camera, its parameters, and whether its focal length is known."""
    h, w = image.size
    if (lens := image.lens) is not None:
        focals = [lens.fx] if MODELS[lens.model].focals == 1 else [lens.fx, lens.fy]
        return lens.model, [*focals, lens.cx + ORIGIN, lens.cy + ORIGIN, *lens.coefficients], True
    if (K := image.K) is not None:
        return "PINHOLE", [float(K[0, 0]), float(K[1, 1]), float(K[0, 2] + ORIGIN), float(K[1, 2] + ORIGIN)], True
    focal = FOCAL_LENGTH * max(h, w) if image.focal is None else image.focal
    return "SIMPLE_RADIAL", [focal, w / 2, h / 2, 0.0], image.focal is not None


def _geometry(
    pair: ExportedPair, matches: NDArray[np.int32], known: dict[str, NDArray[np.float64] | None]
) -> PairGeometry:
    """The geometry of a pair, whose inliers are among the matches (m, 2)."""
    written = set(map(tuple, matches.tolist()))
    if pair.geometry is not None:
        verified = [match for match in pair.geometry.inliers.tolist() if tuple(match) in written]
        return pair.geometry._replace(inliers=np.array(verified, np.int32).reshape(-1, 2))
    if not (pair.related and pair.F.any()):
        return PairGeometry("degenerate", matches[:0])
    index = pair.matches[pair.inliers]
    inliers = index[[tuple(match) in written for match in index.tolist()]]
    K0, K1 = known[pair.name0], known[pair.name1]
    if K0 is None or K1 is None:
        return PairGeometry("uncalibrated", inliers, pair.F)
    return PairGeometry("calibrated", inliers, pair.F, K1.T @ pair.F @ K0)


def _one_to_one(pair: ExportedPair) -> NDArray[np.bool_]:
    """Matches that share no keypoint with a better one: COLMAP's tracks allow one each; inliers come first."""
    keep = np.zeros(len(pair.matches), bool)
    taken0: set[int] = set()
    taken1: set[int] = set()
    inliers = pair.inliers
    if pair.geometry is not None:
        verified = set(map(tuple, pair.geometry.inliers.tolist()))
        inliers = np.array([tuple(match) in verified for match in pair.matches.tolist()], bool)
    for k in np.lexsort((-pair.scores, ~inliers)):
        i, j = pair.matches[k].tolist()
        if i not in taken0 and j not in taken1:
            keep[k] = True
            taken0.add(i)
            taken1.add(j)
    return keep
