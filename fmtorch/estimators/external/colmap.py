"""COLMAP's LO-RANSAC and two-view geometries by pycolmap (extra `colmap`)."""

from typing import Any, Literal

import numpy as np

from fmtorch.estimators.external import pairwise
from fmtorch.estimators.external.pairwise import Confidence, Iterations, PairwiseEstimator, PixelPair, Solution
from fmtorch.estimators.refinement import Pixels

USUAL_FOCAL = 1.2  # in units of the longer side, of a camera without a prior: COLMAP's default
MAX_SEED = 2**31 - 1
Model = Literal["fundamental", "homography"]


@pairwise.computed_by("pycolmap")
def colmap(
    *, threshold: Pixels = 4.0, confidence: Confidence = 0.999, iterations: Iterations = 10000,
    min_iterations: int = 100, two_view: bool = True, model: Model = "fundamental",
) -> PairwiseEstimator:  # fmt: skip
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

    def settings(pair: PixelPair) -> Any:
        options = library.TwoViewGeometryOptions(compute_relative_pose=True)
        options.ransac.max_error, options.ransac.random_seed = threshold, pair.seed % MAX_SEED
        options.ransac.confidence, options.ransac.max_num_trials = confidence, iterations
        options.ransac.min_num_trials = min(min_iterations, iterations)
        return options

    def fundamental(pair: PixelPair) -> Solution:
        if two_view:
            return _two_view(library, pair, settings(pair))
        ransac = settings(pair).ransac
        if pair.exact is None:
            result = library.estimate_fundamental_matrix(pair.x0, pair.x1, ransac)
            return pairwise.without(pair) if result is None else pairwise.solution(result["F"], result["inlier_mask"])
        result = library.estimate_essential_matrix(pair.x0, pair.x1, *_cameras(library, pair), ransac)
        if result is None:
            return pairwise.without(pair)
        R, t = result["cam2_from_cam1"].rotation.matrix(), result["cam2_from_cam1"].translation
        return pairwise.posed(pair.exact, R, t, result["inlier_mask"], result["E"])

    def homography(pair: PixelPair) -> Solution:
        result = library.estimate_homography_matrix(pair.x0, pair.x1, settings(pair).ransac)
        if result is None:
            return pairwise.without(pair)
        H, inliers = np.asarray(result["H"], np.float64), np.asarray(result["inlier_mask"], np.bool_)
        depth = pair.x0[inliers] @ H[2, :2] + H[2, 2]
        return Solution(-H if np.count_nonzero(depth < 0) > np.count_nonzero(depth > 0) else H, inliers)

    return PairwiseEstimator("COLMAP", fundamental if model == "fundamental" else homography, model=model)


def _two_view(library: Any, pair: PixelPair, options: Any) -> Solution:
    """COLMAP's two-view geometry, with F of its pose where there is one; the pose where cameras are asked for."""
    matches = np.repeat(np.arange(len(pair.x0), dtype=np.uint32)[:, None], 2, 1)
    camera0, camera1 = _cameras(library, pair)
    result = library.estimate_two_view_geometry(camera0, pair.x0, camera1, pair.x1, matches, options)
    inliers = np.zeros(len(pair.x0), np.bool_)
    inliers[np.asarray(result.inlier_matches, np.int64).reshape(-1, 2)[:, 0]] = True
    K0, K1 = (
        np.asarray(camera.calibration_matrix()) if K is None and camera is not None else K
        for K, camera in zip(pair.calibrations or (None, None), (result.camera1, result.camera2), strict=True)
    )
    F, R, t = None if result.F is None else np.asarray(result.F, np.float64), None, None
    if K0 is not None and K1 is not None and result.cam2_from_cam1 is not None:
        R, t = np.asarray(result.cam2_from_cam1.rotation.matrix()), np.asarray(result.cam2_from_cam1.translation)
        if library.TwoViewGeometryConfiguration(result.config).name != "UNCALIBRATED" and np.any(t):
            F = pairwise.fundamental_of_pose(K0, K1, R, t)
    if pair.calibrations is None:
        return Solution(F, inliers)
    return Solution(F, inliers, np.array([np.nan if K is None else K[0, 0] for K in (K0, K1)]), R, t)


def _cameras(library: Any, pair: PixelPair) -> list[Any]:
    """The cameras of a pair; an unknown focal length begins at COLMAP's default, for central principal points.
    Cameras of one number share an unknown focal length."""
    cameras: list[Any] = []
    for K, (h, w) in zip(pair.calibrations or (None, None), (pair.size0, pair.size1), strict=True):
        f = USUAL_FOCAL * max(h, w)
        params = [f, f, (w - 1) / 2, (h - 1) / 2] if K is None else [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        number = 1 if pair.shared_focal else len(cameras) + 1
        camera = library.Camera(camera_id=number, model="PINHOLE", width=w, height=h, params=params)
        camera.has_prior_focal_length = K is not None
        cameras.append(camera)
    return cameras
