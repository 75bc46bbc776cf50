"""A COLMAP database of keypoints, matches and two-view geometries, written through pycolmap."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Write a database: keypoints, the matches given to the estimator, and F with its inliers as verified geometry
    where its support is beyond chance.

    A known K is a PINHOLE camera with a trusted focal length; images of equal K and size share it. Otherwise an image
    has a SIMPLE_RADIAL camera of COLMAP's default focal length, or shares it with all of its size. Pixels are moved by
    half of one, as COLMAP counts. With both cameras known the geometry is calibrated, and has E too.
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
            if pair.related and pair.F.any():
                geometry = _geometry(pycolmap, pair, pair.matches[matches & pair.inliers], known)
                database.write_two_view_geometry(*ends, geometry)


def _camera(pycolmap: Any, database: Any, cameras: dict[object, int], image: ExportedImage, shared: bool) -> int:
    """The image's camera, with a rig of its own."""
    key: object = image.name
    if image.K is not None:
        key = (image.size, *image.K.ravel().tolist())
    elif shared:
        key = image.size
    if key not in cameras:
        h, w = image.size
        if image.K is None:
            model, parameters = "SIMPLE_RADIAL", [FOCAL_LENGTH * max(h, w), w / 2, h / 2, 0.0]
        else:
            K = image.K
            model, parameters = "PINHOLE", [K[0, 0], K[1, 1], K[0, 2] + ORIGIN, K[1, 2] + ORIGIN]
        camera = pycolmap.Camera(model=model, width=w, height=h, params=parameters)
        camera.has_prior_focal_length = image.K is not None
        camera.camera_id = cameras[key] = database.write_camera(camera)
        rig = pycolmap.Rig(rig_id=cameras[key])
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    return cameras[key]


def _geometry(
    pycolmap: Any, pair: ExportedPair, inliers: NDArray[np.int32], known: dict[str, NDArray[np.float64] | None]
) -> Any:
    K0, K1 = known[pair.name0], known[pair.name1]
    if K0 is None or K1 is None:
        return two_view_geometry(pycolmap, PairGeometry("uncalibrated", inliers, pair.F))
    return two_view_geometry(pycolmap, PairGeometry("calibrated", inliers, pair.F, K1.T @ pair.F @ K0))


def _one_to_one(pair: ExportedPair) -> NDArray[np.bool_]:
    """Matches that share no keypoint with a better one: COLMAP's tracks allow one each; inliers come first."""
    keep = np.zeros(len(pair.matches), bool)
    taken0: set[int] = set()
    taken1: set[int] = set()
    for k in np.lexsort((-pair.scores, ~pair.inliers)):
        i, j = pair.matches[k].tolist()
        if i not in taken0 and j not in taken1:
            keep[k] = True
            taken0.add(i)
            taken1.add(j)
    return keep
