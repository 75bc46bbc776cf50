"""The geometry of a pair as COLMAP's databases hold it."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

ORIGIN = 0.5  # px: COLMAP's coordinates of the first pixel's centre

Kind = Literal["calibrated", "uncalibrated", "planar", "panoramic", "planar_or_panoramic", "degenerate"]
"""COLMAP's configurations: of a general pair by whether both focal lengths are known, of others by what they show."""
Matrix = NDArray[np.float64] | None


class PairGeometry(NamedTuple):
    """The geometry of one pair, in pixels with (0, 0) at the centre of the first one.

    inliers: keypoints of both images, (n, 2). F, E, H: (3, 3), None where the pair has none; ``x1^T F x0 = 0``,
    ``x1 ~ H x0``. R, t: X1 = R X0 + t.
    """

    kind: Kind
    inliers: NDArray[np.integer[Any]]
    F: Matrix = None
    E: Matrix = None
    H: Matrix = None
    R: Matrix = None
    t: Matrix = None


def two_view_geometry(pycolmap: Any, pair: PairGeometry) -> Any:
    """The `pycolmap.TwoViewGeometry` of a pair: F and H in COLMAP's pixels."""
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.__members__[pair.kind.upper()]
    geometry.inlier_matches = np.ascontiguousarray(pair.inliers, np.uint32)
    back = np.array([[1.0, 0, -ORIGIN], [0, 1, -ORIGIN], [0, 0, 1]])
    if pair.F is not None:
        geometry.F = back.T @ pair.F @ back
    if pair.E is not None:
        geometry.E = pair.E / np.linalg.norm(pair.E)
    if pair.H is not None:
        geometry.H = np.linalg.inv(back) @ pair.H @ back
    if pair.R is not None and pair.t is not None:
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(pair.R), pair.t)
    return geometry
