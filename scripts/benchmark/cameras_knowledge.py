"""What is known of two cameras, from everything to nothing, and poses from fundamental matrices."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.data import ImagePair

Array = NDArray[Any]

LEVELS = {
    "known": "both calibrations are known",
    "rough": "focal lengths are known to 10 %",
    "wrong": "focal lengths are 1.5 times too long",
    "one_sided": "the calibration of image 0 is known",
    "shared": "one unknown focal length",
    "unknown": "nothing is known",
}
ROUGH = 1.1  # largest factor of a roughly known focal length; log-uniform, of each camera its own
DEVIATION = 0.06  # relative, of such a factor: log(1.1) / sqrt(3), rounded up
WRONG = 1.5  # factor of a wrong focal length
USUAL = 1.2  # focal length in units of the longer side where F has no real one: COLMAP's default
ONE_CAMERA = 1e-3  # relative difference up to which two focal lengths are one


class Knowledge(NamedTuple):
    """What a method is given of two cameras.

    K0, K1: (3, 3), None where unknown. deviation: relative standard deviation of their focal lengths, 0 where exact.
    one_camera: whether both images are of one camera. centres: (2, 2), principal points in pixels, those of K0, K1 or
    the centres of the images. longest: (2,), px.
    """

    K0: Array | None
    K1: Array | None
    deviation: float
    one_camera: bool
    centres: Array
    longest: Array

    @property
    def focals(self) -> Array:
        """The focal lengths (2,) in pixels, geometric means of those along x and y; NaN where unknown."""
        return np.array([np.nan if K is None else np.sqrt(K[0, 0] * K[1, 1]) for K in (self.K0, self.K1)])

    def calibrations(self, focals: Array) -> tuple[Array, Array]:
        """Calibrations of square pixels with these focal lengths (2,) in pixels."""
        K0, K1 = (np.array([[f, 0, x], [0, f, y], [0, 0, 1]]) for f, (x, y) in zip(focals, self.centres, strict=True))
        return K0, K1


class Answer(NamedTuple):
    """What a method finds of a pair. F: (3, 3). R, t: X1 = R X0 + t. focals: (2,), px, where they are estimated."""

    F: Array | None
    R: Array | None = None
    t: Array | None = None
    focals: Array | None = None


NOTHING = Answer(None)


def applies(level: str, pair: ImagePair) -> bool:
    """Whether what a level takes for true holds: `shared` is of pairs of one camera."""
    if level != "shared":
        return True
    f0, f1 = knowledge("known", pair, np.ones((2, 2)), 0).focals
    return bool(abs(np.log(f0 / f1)) < ONE_CAMERA)


def knowledge(level: str, pair: ImagePair, sizes: Array, seed: int) -> Knowledge:
    """What a level tells of a pair's cameras. sizes: (2, 2) as (h, w). seed: of roughly known focal lengths.

    Raises ValueError for another level.
    """
    if level not in LEVELS:
        raise ValueError(f"level is {level!r}; it must be one of: {', '.join(LEVELS)}")
    factors, deviation = np.ones(2), 0.0
    if level == "rough":
        rng = np.random.default_rng([pair.key % 2**64, seed])
        factors, deviation = np.exp(rng.uniform(-np.log(ROUGH), np.log(ROUGH), 2)), DEVIATION
    elif level == "wrong":
        factors, deviation = np.full(2, WRONG), DEVIATION
    given = {"one_sided": 1, "shared": 0, "unknown": 0}.get(level, 2)
    K = [_scaled(K, factor) if i < given else None for i, (K, factor) in enumerate(zip(_K(pair), factors, strict=True))]
    centres = np.array([(size[::-1] - 1) / 2 if k is None else k[:2, 2] for k, size in zip(K, sizes, strict=True)])
    return Knowledge(K[0], K[1], deviation, level == "shared", centres, sizes.max(1).astype(float))


def _K(pair: ImagePair) -> tuple[Array, Array]:
    assert pair.K0 is not None
    assert pair.K1 is not None
    return pair.K0, pair.K1


def _scaled(K: Array, factor: float) -> Array:
    """The calibration with its focal lengths times a factor."""
    return np.asarray(K @ np.diag([factor, factor, 1.0]))


def fundamental(K0: Array, K1: Array, R: Array, t: Array) -> Array:
    """K1^-T [t]x R K0^-1."""
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.asarray(np.linalg.inv(K1).T @ cross @ R @ np.linalg.inv(K0))


def rays(K: Array, x: Array) -> Array:
    """Points (n, 2) in pixels as normalised image points (n, 2)."""
    return np.asarray((np.c_[x, np.ones(len(x))] @ np.linalg.inv(K).T)[:, :2])


def posed(F: Array, K0: Array, K1: Array, x: tuple[Array, Array], inliers: Array) -> tuple[Array, Array]:
    """R and t of E = K1^T F K0 with most inliers (n,) in front of both cameras, by OpenCV."""
    E, far = K1.T @ F @ K0, 1e9  # baselines: OpenCV's own bound of 50 rejects short ones
    normalised = [np.ascontiguousarray(rays(K, points[inliers])) for K, points in zip((K0, K1), x, strict=True)]
    _, R, t, _, _ = cv2.recoverPose(E, normalised[0], normalised[1], np.eye(3), distanceThresh=far)
    return np.asarray(R), np.asarray(t).ravel()


def answer(F: Array | None, given: Knowledge, x: tuple[Array, Array], inliers: Array) -> Answer:
    """The pose of a fundamental matrix, with the given calibrations or else focal lengths by `bougnoux`."""
    if F is None or F.shape != (3, 3) or not np.isfinite(F).all() or not inliers.any():
        return NOTHING
    if given.K0 is not None and given.K1 is not None:
        return Answer(F, *posed(F, given.K0, given.K1, x, inliers))
    focals = bougnoux(F, given)
    K0, K1 = (k if K is None else K for k, K in zip(given.calibrations(focals), (given.K0, given.K1), strict=True))
    return Answer(F, *posed(F, K0, K1, x, inliers), focals)


def bougnoux(F: Array, given: Knowledge) -> Array:
    """Focal lengths (2,) in pixels by Bougnoux's formula (ICCV 1998); usual ones for both where one is not real."""
    centre0, centre1 = given.calibrations(np.ones(2))
    G = centre1.T @ F @ centre0
    squares = np.array([_squared_focal(G), _squared_focal(G.T)])
    usual = USUAL * given.longest
    return np.sqrt(squares) if np.isfinite(squares).all() and (squares > 0).all() else usual


def _squared_focal(G: Array) -> float:
    """The squared focal length of the camera whose points G's columns belong to."""
    p, D = np.array([0, 0, 1.0]), np.diag([1.0, 1, 0])
    e = np.linalg.svd(G.T)[2][2]
    row = np.cross(p, e) @ D @ G  # p^T [e]x D G
    with np.errstate(all="ignore"):
        return float(-(row @ p) * (p @ G.T @ p) / (row @ D @ G.T @ p))
