"""Relative poses by other libraries: PoseLib, COLMAP, OpenCV, kornia, SupeRANSAC. Thresholds are in pixels."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from fmtorch.estimators.external import colmap
from scripts.benchmark.cameras_knowledge import (
    NOTHING,
    USUAL,
    Answer,
    Array,
    Knowledge,
    answer,
    fundamental,
    posed,
    rays,
)

Points = tuple[Array, Array]
Peer = Callable[[Points, Knowledge, int], Answer]
MIN_MATCHES = 8
FAILURES = (cv2.error, RuntimeError, ValueError, np.linalg.LinAlgError)  # how these libraries refuse a pair

PACKAGES = {
    "poselib": "poselib", "poselib_f": "poselib", "colmap": "pycolmap", "colmap_f": "pycolmap",
    "opencv": "opencv-python-headless", "kornia": "kornia", "superansac": "pysuperansac",
}  # fmt: skip
"""The package of each peer. ``_f``: its fundamental matrix, of which the pose is taken."""
EXACT = ("known", "rough", "wrong")
TAKES = {
    "poselib": (*EXACT, "shared"), "poselib_f": (*EXACT, "one_sided", "shared", "unknown"),
    "colmap": (*EXACT, "one_sided", "shared", "unknown"), "colmap_f": EXACT, "opencv": EXACT, "kornia": EXACT,
    "superansac": EXACT,
}  # fmt: skip
"""The levels of knowledge that each takes. None has a deviation: a calibration that is given is taken for exact."""


def peer(name: str, level: str, **options: Any) -> Peer:
    """A peer's estimator, of matches that come best first.

    Raises:
        ValueError: for another name, or a level that this peer has no estimator of.
        ImportError: where its package is not installed.
    """
    if name not in PACKAGES:
        raise ValueError(f"no method {name!r}; there are {', '.join(PACKAGES)}")
    if level not in TAKES[name]:
        raise ValueError(f"{name} has no estimator for {level!r}; it has: {', '.join(TAKES[name])}")
    solve = _shared_focal if (name, level) == ("poselib", "shared") else SOLVERS[name]
    return functools.partial(_sound, functools.partial(solve, **options))


def version(name: str) -> str:
    """The version of a peer's package."""
    return importlib.metadata.version(PACKAGES[name])


def _sound(solve: Peer, x: Points, given: Knowledge, seed: int) -> Answer:
    """What a peer finds; nothing where it refuses, or there are too few matches."""
    if len(x[0]) < MIN_MATCHES:
        return NOTHING
    try:
        return solve(x, given, seed)
    except FAILURES:
        return NOTHING


def _both(given: Knowledge) -> tuple[Array, Array]:
    assert given.K0 is not None
    assert given.K1 is not None
    return given.K0, given.K1


def _of_pose(given: Knowledge, R: Array, t: Array, F: Array | None = None) -> Answer:
    """The pose for exact calibrations, with its F unless another is given."""
    return Answer(fundamental(*_both(given), R, t) if F is None else F, R, t)


def _ransac(threshold: float, iterations: int, prosac: bool, seed: int) -> dict[str, Any]:
    return {
        "max_epipolar_error": threshold, "max_iterations": iterations, "min_iterations": min(1000, iterations),
        "progressive_sampling": prosac, "seed": seed,
    }  # fmt: skip


def _poselib(
    x: Points, given: Knowledge, seed: int, *, threshold: float = 1.0, iterations: int = 5000, prosac: bool = True
) -> Answer:
    import poselib

    cameras = [
        {"model": "PINHOLE", "width": int(2 * K[0, 2]), "height": int(2 * K[1, 2]),
         "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
        for K in _both(given)
    ]  # fmt: skip
    pose, _ = poselib.estimate_relative_pose(*x, *cameras, _ransac(threshold, iterations, prosac, seed), {})
    return _of_pose(given, np.asarray(pose.R), np.asarray(pose.t))


def _shared_focal(
    x: Points, given: Knowledge, seed: int, *, threshold: float = 1.0, iterations: int = 5000, prosac: bool = True
) -> Answer:
    import poselib

    options = _ransac(threshold, iterations, prosac, seed)
    pair, _ = poselib.estimate_shared_focal_relative_pose(*x, given.centres[0], options, {})
    focals = np.full(2, pair.camera1.params[0])
    if not np.isfinite(focals).all() or not (focals > 0).all():
        return NOTHING
    R, t = np.asarray(pair.pose.R), np.asarray(pair.pose.t)
    return Answer(fundamental(*given.calibrations(focals), R, t), R, t, focals)


def _poselib_f(
    x: Points, given: Knowledge, seed: int, *, threshold: float = 1.0, iterations: int = 5000, prosac: bool = True
) -> Answer:
    import poselib

    F, info = poselib.estimate_fundamental(*x, _ransac(threshold, iterations, prosac, seed), {})
    return answer(np.asarray(F), given, x, np.asarray(info["inliers"], np.bool_))


def _colmap(x: Points, given: Knowledge, seed: int, *, threshold: float = 4.0) -> Answer:
    """COLMAP's two-view geometry: E for two calibrations, one focal length for one or none, F where it prefers that."""
    usual = given.calibrations(USUAL * given.longest)  # cameras without a prior start at COLMAP's default
    cameras = [
        colmap.Camera(usual[i] if K is None else K, K is not None, 1 if given.one_camera else i + 1)
        for i, K in enumerate((given.K0, given.K1))
    ]
    geometry = colmap.two_view_geometry(*x, (cameras[0], cameras[1]), colmap.two_view_options(threshold, seed))
    if geometry.R is None or geometry.K0 is None or geometry.K1 is None:
        return answer(geometry.F, given, x, geometry.inliers)
    exact = given.K0 is not None and given.K1 is not None
    return Answer(
        geometry.F, geometry.R, geometry.t, None if exact else np.array([geometry.K0[0, 0], geometry.K1[0, 0]])
    )


def _colmap_f(x: Points, given: Knowledge, seed: int, *, threshold: float = 4.0) -> Answer:
    options = importlib.import_module("pycolmap").RANSACOptions(max_error=threshold, random_seed=seed)
    F, inliers = colmap.fundamental_matrix(*x, options)
    return answer(F, given, x, inliers)


def _opencv(
    x: Points, given: Knowledge, seed: int, *, method: str = "USAC_MAGSAC", threshold: float = 1.0,
    confidence: float = 0.999,
) -> Answer:  # fmt: skip
    cv2.setRNGSeed(seed)
    K0, K1 = _both(given)
    E, mask = cv2.findEssentialMat(*x, K0, None, K1, None, getattr(cv2, method), confidence, threshold)
    return _of_essential(E, mask, x, given)


def _kornia(
    x: Points, given: Knowledge, seed: int, *, threshold: float = 1.0, rounds: int = 10, prosac: bool = True
) -> Answer:
    import torch
    from kornia.geometry import RANSAC

    K = _both(given)
    unit = float(np.mean([k[[0, 1], [0, 1]].mean() for k in K]))  # px
    estimator = RANSAC("essential", inl_th=threshold / unit, max_iter=rounds, prosac_sampling=prosac, seed=seed)
    E, mask = estimator(*(torch.from_numpy(rays(k, points)) for k, points in zip(K, x, strict=True)))
    return _of_essential(E.double().numpy(), mask.numpy(), x, given)


def _superansac(
    x: Points, given: Knowledge, seed: int, *, threshold: float = 1.5, iterations: int = 5000, sampler: str = "PROSAC",
    score: str = "MAGSAC",
) -> Answer:  # fmt: skip
    library = importlib.import_module("pysuperansac")
    K0, K1 = _both(given)
    settings = library.RANSACSettings()
    settings.sampler, settings.scoring = getattr(library.SamplerType, sampler), getattr(library.ScoringType, score)
    settings.inlier_threshold, settings.confidence = threshold, 0.9999
    settings.min_iterations, settings.max_iterations = min(1000, iterations), iterations
    sizes = [float(2 * v) for K in (K0, K1) for v in K[:2, 2]]
    E, indices, _, _ = library.estimateEssentialMatrix(
        np.ascontiguousarray(np.hstack(x)), K0, K1, sizes, config=settings
    )
    inliers = np.zeros(len(x[0]), np.bool_)
    inliers[indices] = True
    return _of_essential(np.asarray(E), inliers, x, given)


def _of_essential(E: Array | None, mask: Array | None, x: Points, given: Knowledge) -> Answer:
    """The pose of an essential matrix and its inliers."""
    if E is None or mask is None or E.shape != (3, 3) or not np.isfinite(E).all():
        return NOTHING
    K0, K1 = _both(given)
    F = np.linalg.inv(K1).T @ E @ np.linalg.inv(K0)
    inliers = np.asarray(mask).ravel().astype(np.bool_)
    return Answer(F, *posed(F, K0, K1, x, inliers)) if inliers.any() else NOTHING


SOLVERS: dict[str, Callable[..., Answer]] = {
    "poselib": _poselib, "poselib_f": _poselib_f, "colmap": _colmap, "colmap_f": _colmap_f, "opencv": _opencv,
    "kornia": _kornia, "superansac": _superansac,
}  # fmt: skip
