"""Images of a COLMAP database: keypoints as of an ideal pinhole, and what is known of cameras."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.data.lenses import MODELS, Lens
from fmtorch.geometry.square_pixels import calibration_problems
from fmtorch.storage.exchange.two_view import ORIGIN

EXIF_DEVIATION = 0.05  # relative, of focal lengths by EXIF (docs/cameras.md)

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class DatabaseImage:
    """An image with its keypoints, px, with (0, 0) at the centre of the first pixel.

    size: (h, w), and K, None where unknown. points: (n, 2) as stored; pinhole: (n, 2), where a pinhole of calibration K
    would have put them, NaN where it sees nothing. deviation: relative, of the focal length of K: 0 where it was
    calibrated, infinite where it is COLMAP's guess. problem: what is wrong with the camera.

    Scales, orientations and affine shapes of keypoints are not used: docs/verify.md says what they were worth.
    """

    name: str
    camera_id: int
    size: tuple[int, int] | None
    K: Array | None
    deviation: float
    points: NDArray[np.float32]
    pinhole: NDArray[np.float32]
    problem: str = ""


def database_image(name: str, camera: Any, keypoints: NDArray[np.float32]) -> DatabaseImage:
    """The image of a `pycolmap.Camera` and its keypoints (n, 2), (n, 4) or (n, 6); raises ValueError for others."""
    size, columns = (int(camera.height), int(camera.width)), keypoints.shape[1]
    if columns not in (2, 4, 6):
        raise ValueError(f"the keypoints of {name} have {columns} columns; they must have 2, 4 or 6")
    points = keypoints[:, :2] - np.float32(ORIGIN)
    model = str(camera.model_name)
    problem, K, deviation = "", np.eye(3), math.inf
    if model not in MODELS:
        problem = f"camera {camera.camera_id} of {name} is {model}, which is no pinhole behind a lens"
    else:
        lens = MODELS[model].lens(model, np.asarray(camera.params, np.float64))
        K = lens.K - np.array([[0, 0, ORIGIN], [0, 0, ORIGIN], [0, 0, 0]])
        wrong = calibration_problems(torch.from_numpy(K)[None], torch.tensor([size]), "its calibration")[0]
        problem = f"camera {camera.camera_id} of {name}: {wrong}" if wrong else ""
        deviation = _deviation(camera, lens, K)
    if problem or not lens.bends:
        return DatabaseImage(name, camera.camera_id, size, K, deviation, points, points, problem)
    pinhole = _undistorted(camera, K, keypoints[:, :2])
    return DatabaseImage(name, camera.camera_id, size, K, deviation, points, pinhole.astype(np.float32), problem)


def _deviation(camera: Any, lens: Lens, K: Array) -> float:
    """Relative, of the focal length: that of EXIF where nothing else of the camera is known, else of a calibration."""
    if not camera.has_prior_focal_length:
        return math.inf
    centre = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    usual = lens.fx == lens.fy and tuple(K[:2, 2]) == centre and not any(lens.coefficients)
    return EXIF_DEVIATION if usual else 0.0


def _undistorted(camera: Any, K: Array, points: NDArray[Any]) -> Array:
    """Pixels (n, 2) of a pinhole for COLMAP's pixels (n, 2) of the photograph."""
    rays = np.asarray(camera.cam_from_img(np.ascontiguousarray(points, np.float64)), np.float64).reshape(-1, 2)
    return np.asarray(rays @ K[:2, :2].T + K[:2, 2])
