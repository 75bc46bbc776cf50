"""COLMAP's LO-RANSAC and two-view geometries by pycolmap (extra `colmap`)."""

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmtorch.estimators.external import pairwise
from fmtorch.estimators.external.pairwise import Confidence, Iterations, Pair, PairwiseEstimator, Points, Solution

USUAL_FOCAL = 1.2  # in units of the longer side, of a camera without a prior: COLMAP's default
MAX_SEED = 2**31 - 1
Model = Literal["fundamental", "homography"]


class Camera(NamedTuple):
    """A pinhole camera. K: (3, 3), px. known: whether its focal length is, or a first guess. number: cameras of one
    number share an unknown focal length. size: (h, w); twice the principal point when not given."""

    K: Points
    known: bool = True
    number: int = 1
    size: tuple[int, int] | None = None


class TwoView(NamedTuple):
    """COLMAP's two-view geometry. configuration: its name, such as CALIBRATED. F: (3, 3), px, of the pose where there
    is one. R, t: X1 = R X0 + t. K0, K1: of the pose, None where they are neither given nor estimated."""

    configuration: str
    F: Points | None
    R: Points | None
    t: Points | None
    K0: Points | None
    K1: Points | None
    inliers: NDArray[np.bool_]


@pairwise.computed_by("pycolmap")
def colmap(
    *,
    threshold: float = 4.0,
    confidence: Confidence = 0.999,
    iterations: Iterations = 10000,
    min_iterations: int = 100,
    two_view: bool = True,
    model: Model = "fundamental",
) -> PairwiseEstimator:
    """COLMAP's estimators (Schoenberger & Frahm, CVPR 2016) with the defaults of its verification of matches.

    Where both focal lengths are known (`find_essential`, `cameras=known`) the model is an essential matrix. COLMAP's
    verification takes those that are known roughly for exact.

    Args:
        threshold: pixels, Sampson distance; of homographies the distance in image 1.
        confidence, iterations: as of `opencv`.
        min_iterations: samples at least, though not more than at most.
        two_view: choose between E, F and H as COLMAP's verification does, from 15 inliers on, with unknown focal
            lengths where they are asked for and it finds them. False: LO-RANSAC of E or F alone.
        model: what is estimated; a homography by LO-RANSAC alone.

    Raises:
        ImportError: with a hint, where pycolmap is not installed.
    """
    library = pairwise.peer("pycolmap", "COLMAP", extra="colmap")

    def settings(pair: Pair) -> Any:
        options = two_view_options(threshold, pair.seed)
        ransac = options.ransac
        ransac.confidence, ransac.max_num_trials = confidence, iterations
        ransac.min_num_trials = min(min_iterations, iterations)
        return options

    def fundamental(pair: Pair) -> Solution:
        cameras = None if pair.calibrations is None else _cameras(pair)
        if two_view:
            geometry = two_view_geometry(pair.x0, pair.x1, cameras or _cameras(pair), settings(pair))
            if cameras is None:
                return geometry.F, geometry.inliers
            focals = np.array([np.nan if K is None else K[0, 0] for K in (geometry.K0, geometry.K1)])
            return pairwise.Posed(geometry.F, geometry.inliers, focals, geometry.R, geometry.t)
        ransac = settings(pair).ransac
        if cameras is not None and pair.exact is not None:
            ends = (_pinhole(library, camera) for camera in cameras)
            result = library.estimate_essential_matrix(pair.x0, pair.x1, *ends, ransac)
            return pairwise.without(pair) if result is None else _posed(result, pair.exact)
        result = library.estimate_fundamental_matrix(pair.x0, pair.x1, ransac)
        return pairwise.without(pair) if result is None else pairwise.solution(result["F"], result["inlier_mask"])

    def homography(pair: Pair) -> Solution:
        result = library.estimate_homography_matrix(pair.x0, pair.x1, settings(pair).ransac)
        if result is None:
            return pairwise.without(pair)
        H, inliers = np.asarray(result["H"], np.float64), np.asarray(result["inlier_mask"], np.bool_)
        depth = pair.x0[inliers] @ H[2, :2] + H[2, 2]
        return (-H if np.count_nonzero(depth < 0) > np.count_nonzero(depth > 0) else H), inliers

    return PairwiseEstimator("COLMAP", fundamental if model == "fundamental" else homography, model=model)


def two_view_options(threshold: float, seed: int) -> Any:
    """`pycolmap.TwoViewGeometryOptions` at a threshold in pixels, with relative poses."""
    options = pairwise.peer("pycolmap", "COLMAP", extra="colmap").TwoViewGeometryOptions(compute_relative_pose=True)
    options.ransac.max_error, options.ransac.random_seed = threshold, seed % MAX_SEED
    return options


def two_view_geometry(x0: Points, x1: Points, cameras: tuple[Camera, Camera], options: Any) -> TwoView:
    """COLMAP's two-view geometry of matches (n, 2) in pixels. options: `pycolmap.TwoViewGeometryOptions`."""
    library = pairwise.peer("pycolmap", "COLMAP", extra="colmap")
    matches = np.repeat(np.arange(len(x0), dtype=np.uint32)[:, None], 2, 1)
    ends = [_pinhole(library, camera) for camera in cameras]
    result = library.estimate_two_view_geometry(ends[0], x0, ends[1], x1, matches, options)
    inliers = np.zeros(len(x0), np.bool_)
    inliers[np.asarray(result.inlier_matches, np.int64).reshape(-1, 2)[:, 0]] = True
    configuration = library.TwoViewGeometryConfiguration(result.config).name
    K0, K1 = (
        camera.K if camera.known else None if estimated is None else np.asarray(estimated.calibration_matrix())
        for camera, estimated in zip(cameras, (result.camera1, result.camera2), strict=True)
    )
    F = None if result.F is None else np.asarray(result.F, np.float64)
    if K0 is None or K1 is None or result.cam2_from_cam1 is None:
        return TwoView(configuration, F, None, None, K0, K1, inliers)
    R, t = np.asarray(result.cam2_from_cam1.rotation.matrix()), np.asarray(result.cam2_from_cam1.translation)
    if configuration != "UNCALIBRATED" and np.any(t):
        F = pairwise.fundamental_of_pose(K0, K1, R, t)
    return TwoView(configuration, F, R, t, K0, K1, inliers)


def _posed(result: Any, K: tuple[Points, Points]) -> pairwise.Posed:
    """COLMAP's relative pose with F of its essential matrix, px."""
    pose = result["cam2_from_cam1"]
    return pairwise.posed(K, pose.rotation.matrix(), pose.translation, result["inlier_mask"], result["E"])


def _cameras(pair: Pair) -> tuple[Camera, Camera]:
    """The cameras of a pair; an unknown focal length begins at COLMAP's default, for central principal points."""
    cameras: list[Camera] = []
    for K, (h, w) in zip(pair.calibrations or (None, None), (pair.size0, pair.size1), strict=True):
        f = USUAL_FOCAL * max(h, w)
        guess = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
        number = 1 if pair.shared_focal else len(cameras) + 1
        cameras.append(Camera(guess if K is None else K, K is not None, number, (h, w)))
    return cameras[0], cameras[1]


def _pinhole(library: Any, camera: Camera) -> Any:
    K = camera.K
    h, w = camera.size or (int(2 * K[1, 2]) + 1, int(2 * K[0, 2]) + 1)
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    pinhole = library.Camera(camera_id=camera.number, model="PINHOLE", width=w, height=h, params=params)
    pinhole.has_prior_focal_length = camera.known
    return pinhole
