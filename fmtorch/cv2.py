"""OpenCV's functions of two views with this project's estimators: ``from fmtorch import cv2``.

`findFundamentalMat`, `findEssentialMat`, `findHomography` and `recoverPose` have OpenCV's signatures and return values;
every other name of this module is OpenCV's own. Flags stand for presets, see `PRESETS`. What OpenCV computes from all
points (FM_7POINT, FM_8POINT, method 0 of homographies) it computes here, too.

Thresholds decide which matches the mask holds, as OpenCV's do; by which distances models are searched and fitted is the
presets' own. `confidence` and `maxIters` where they are not given are the presets', too. Image sizes are assumed from
the points' extent, as `fmtorch.find_fundamental` does where none are given. Cameras of two kinds, priors and gradients
have no place in these signatures, but in its own."""

from typing import Any

import cv2 as opencv
import numpy as np
from numpy.typing import NDArray

from fmtorch.core.checks import as_tensor
from fmtorch.core.types import Estimate
from fmtorch.two_view import find
from fmtorch.two_view.arguments import MIN_PIXELS

Matrix = NDArray[np.float64]
Mask = NDArray[np.uint8]

PRESETS = {
    opencv.RANSAC: "fmtorch",
    opencv.LMEDS: "lmeds",
    opencv.USAC_DEFAULT: "fmtorch",
    opencv.USAC_PARALLEL: "fmtorch",
    opencv.USAC_FM_8PTS: "ransac_eight_point",
    opencv.USAC_FAST: "fmtorch_fast",
    opencv.USAC_ACCURATE: "gc_ransac",
    opencv.USAC_PROSAC: "usac",
    opencv.USAC_MAGSAC: "magsac",
}
"""The presets of fundamental and essential matrices by OpenCV's flags (FM_RANSAC is RANSAC, FM_LMEDS is LMEDS)."""
OF_ALL_POINTS = (opencv.FM_7POINT, opencv.FM_8POINT)
UNIT_FOCAL = 1000.0  # px, of the camera that normalised points are scaled to
REACH_PX, MAX_REACH_PX = 1000.0, 1e5  # of points in another unit, as they are scaled; of pixels, at most
MIN_THRESHOLD, USUAL_THRESHOLD, MAX_THRESHOLD = 0.5, 3.0, 10.0  # px: OpenCV's usual one; others may be of another unit
RANK = 1e-6  # of the eighth singular value, in the first, below which equations determine no F
FARTHEST = 1e9  # baselines
TO_THE_END = (opencv.TERM_CRITERIA_COUNT + opencv.TERM_CRITERIA_EPS, 100, 1e-12)
MIN_H = 4  # matches of a homography


def findFundamentalMat(  # OpenCV's name, as all of this module
    points1: Any, points2: Any, method: Any = opencv.FM_RANSAC, ransacReprojThreshold: float | int = 3.0,
    confidence: float | int | None = None, maxIters: Any = None, mask: Mask | None = None,
) -> tuple[Matrix | None, Mask | None]:  # fmt: skip
    """The fundamental matrix of matched points, ``p2^T F p1 = 0``, as `cv2.findFundamentalMat` returns it.

    Args:
        points1, points2: (N, 2), (N, 1, 2) or (1, N, 2), or homogeneous with 3 in place of 2; in pixels, or in another
            unit, as of a focal length of 1, with a threshold in it.
        method: FM_RANSAC, FM_LMEDS or USAC_*, see `PRESETS`; FM_7POINT and FM_8POINT are OpenCV's own, None where the
            points leave more than one F.
        ransacReprojThreshold: largest Sampson distance of an inlier, px; LMedS takes none.
        confidence: of having drawn a sample without an outlier, at which the search ends; None: the preset's.
        maxIters: samples at most; None: the preset's. A mask may stand here, as in OpenCV's shorter form.
        mask: written to, if given; zeros where there is no F.

    Returns:
        F (3, 3), of which the last entry is 1, and the mask (N, 1) of inliers, uint8; (None, None) where there is no F.

    Raises:
        ValueError: for another method, and as `fmtorch.find_fundamental`.

    Example:
        >>> import numpy as np
        >>> from fmtorch import cv2
        >>> rng = np.random.default_rng(0)
        >>> X = rng.random((80, 3)) + [0, 0, 2]
        >>> p1, p2 = (500 * Y[:, :2] / Y[:, 2:] for Y in (X, X + [-0.5, 0, 0.2]))
        >>> F, mask = cv2.findFundamentalMat(p1, p2, cv2.FM_RANSAC, 3.0, 0.99)
        >>> F.shape, mask.shape, int(mask.sum())
        ((3, 3), (80, 1), 80)
    """
    if isinstance(maxIters, np.ndarray):
        maxIters, mask = None, maxIters
    x1, x2 = _points_of(points1, "points1"), _points_of(points2, "points2")
    if method in OF_ALL_POINTS:
        if not np.isfinite(np.r_[x1, x2]).all() or (method == opencv.FM_8POINT and _deficient(x1, x2)):
            return None, _written(None, mask)
        of_all: Any = opencv.findFundamentalMat(x1, x2, method)
        return of_all[0], _written(of_all[1], mask)
    scale, threshold = _in_pixels([x1, x2], ransacReprojThreshold, method)
    name, options = _preset(method, threshold, confidence, maxIters)
    estimate = find.find_fundamental(scale * x1, scale * x2, estimator=name, **options)
    S = np.diag([scale, scale, 1.0])
    return _result(estimate, S @ estimate.F[0].cpu().numpy() @ S, mask)


def findHomography(
    srcPoints: Any, dstPoints: Any, method: Any = 0, ransacReprojThreshold: float | int = 3.0, mask: Mask | None = None,
    maxIters: int | None = None, confidence: float | int | None = None,
) -> tuple[Matrix | None, Mask | None]:  # fmt: skip
    """The homography of matched points, ``p2 ~ H p1``, as `cv2.findHomography` returns it.

    Args:
        srcPoints: (N, 2), (N, 1, 2) or (1, N, 2), in pixels or in the unit of a plane.
        dstPoints: the same number, in pixels, or in another unit with a threshold in it.
        method: RANSAC, LMEDS, RHO or USAC_*: the preset `homography`; 0, of all points, is OpenCV's own.
        ransacReprojThreshold: largest Sampson distance of an inlier, px.
        mask, maxIters, confidence: as of `findFundamentalMat`.

    Returns:
        H (3, 3), of which the last entry is 1, and the mask (N, 1) of inliers, uint8; None and a mask of zeros where
        there is no H.

    Raises:
        ValueError: as `fmtorch.find_homography`. cv2.error: for fewer than four points.
    """
    src, dst = _points_of(srcPoints, "srcPoints"), _points_of(dstPoints, "dstPoints")
    if method == 0 or len(src) < MIN_H:
        of_all: Any = opencv.findHomography(src, dst, method) if np.isfinite(np.r_[src, dst]).all() else (None, None)
        inliers = _written(of_all[1], mask)
        return of_all[0], np.zeros((len(src), 1), np.uint8) if inliers is None else inliers
    scale, threshold = _in_pixels([dst], ransacReprojThreshold, method, src)
    method = opencv.RANSAC if method == opencv.RHO else method
    _, options = _preset(method, threshold, confidence, maxIters)
    options["inlier_threshold"] = threshold
    estimate = find.find_homography(src, scale * dst, **options)
    H, inliers = _result(estimate, np.diag([1 / scale, 1 / scale, 1.0]) @ estimate.H[0].cpu().numpy(), mask)
    return H, np.zeros((len(src), 1), np.uint8) if inliers is None else inliers


def findEssentialMat(points1: Any, points2: Any, *arguments: Any, **named: Any) -> tuple[Matrix | None, Mask | None]:
    """The essential matrix of matched points, as `cv2.findEssentialMat` returns it, in its three forms.

    ``(points1, points2, cameraMatrix[, method[, prob[, threshold[, maxIters[, mask]]]]])``,
    ``(points1, points2[, focal[, pp[, method[, prob[, threshold[, maxIters[, mask]]]]]]])``,
    ``(points1, points2, cameraMatrix1, distCoeffs1, cameraMatrix2, distCoeffs2[, method[, prob[, threshold[,
    mask]]]])``.

    Args:
        points1, points2: (N, 2), (N, 1, 2) or (1, N, 2), in the unit of the camera matrices.
        method, prob, threshold, maxIters, mask: as of `findFundamentalMat`; threshold is 1 by default.

    Returns:
        E (3, 3) and the mask (N, 1) of inliers, uint8; (None, None) where there is no E.

    Raises:
        ValueError, TypeError: for another form, and as `fmtorch.find_essential`.
    """
    x1, x2, K1, K2, rest = _calibrated(points1, points2, arguments, named)
    focal = float(np.abs([K1[0, 0], K1[1, 1], K2[0, 0], K2[1, 1]]).max())
    prob, threshold, method = rest.get("prob"), rest.get("threshold", 1.0), rest.get("method", opencv.RANSAC)
    scale = UNIT_FOCAL / focal if focal < MIN_PIXELS else min(_in_pixels([x1, x2], threshold, method)[0], 1.0)
    S = np.diag([scale, scale, 1])  # thresholds are in the unit of the points
    name, options = _preset(method, scale * threshold, prob, rest.get("maxIters"))
    estimate = find.find_essential(scale * x1, scale * x2, S @ K1, S @ K2, estimator=name, **options)
    if estimate.E is None or not bool(estimate.ok[0] & estimate.E.isfinite().all()):
        return None, _written(None, rest.get("mask"))
    inliers = estimate.inliers[0].cpu().numpy().astype(np.uint8)[:, None]
    return estimate.E[0].cpu().numpy(), _written(inliers, rest.get("mask"))


def recoverPose(*arguments: Any, **named: Any) -> Any:
    """The pose of an essential matrix in OpenCV's forms, as `cv2.recoverPose` returns it.
    ``(E, points1, points2, cameraMatrix[, R[, t[, mask]]])`` and ``(E, points1, points2[, R[, t[, focal[, pp[,
    mask]]]]])`` choose between the four poses of E by all points, however far they are; OpenCV by those within 50
    baselines, among which there are none where the camera hardly moves. With ``distanceThresh`` it is OpenCV's own.
    In the form ``(points1, points2, cameraMatrix1, distCoeffs1, cameraMatrix2, distCoeffs2, ...)``, without a matrix,
    that is of `findEssentialMat` above: ``retval, E, R, t, mask``. Raises ValueError where there is none."""
    cameras = len(arguments) > 4 and np.shape(arguments[2]) == np.shape(arguments[4]) == (3, 3)
    if "cameraMatrix2" not in named and (not cameras or np.shape(arguments[0]) == (3, 3)):
        return _pose_of_matrix(arguments, named)
    names = ("points1", "points2", "cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "E", "R", "t")
    given = {**dict(zip((*names, "method", "prob", "threshold", "mask"), arguments, strict=False)), **named}
    kept = {name: given[name] for name in ("method", "prob", "threshold") if given.get(name) is not None}
    E, inliers = findEssentialMat(*(given[name] for name in names[:6]), **kept)
    if E is None or inliers is None:
        _written(None, given.get("mask"))
        raise ValueError("no essential matrix agrees with the points")
    x1, x2, *_ = _calibrated(given["points1"], given["points2"], tuple(given[name] for name in names[2:6]), {})
    matrices = (_array(given[name], name) for name in ("cameraMatrix1", "cameraMatrix2"))
    y1, y2 = (opencv.undistortPoints(x[:, None], K, None) for x, K in zip((x1, x2), matrices, strict=True))
    retval, R, t, mask, _ = opencv.recoverPose(E, y1, y2, np.eye(3), distanceThresh=FARTHEST, mask=inliers)
    for name, value in (("E", E), ("R", R), ("t", t), ("mask", mask)):
        _put(value, given.get(name))
    return retval, E, R, t, mask


def _pose_of_matrix(arguments: tuple[Any, ...], named: dict[str, Any]) -> Any:
    rest = arguments[3:]
    if "distanceThresh" in named or (len(rest) > 1 and isinstance(rest[1], int | float)):
        return opencv.recoverPose(*arguments, **named)
    by_matrix = "cameraMatrix" in named or (rest and np.shape(rest[0]) == (3, 3))
    names = ("cameraMatrix", "R", "t", "mask") if by_matrix else ("R", "t", "focal", "pp", "mask")
    given = {**dict(zip(("E", "points1", "points2", *names), arguments, strict=False)), **named}
    if missing := [name for name in ("E", "points1", "points2") if name not in given]:
        raise TypeError(f"recoverPose needs {', '.join(missing)}")
    (cx, cy), f = given.get("pp", (0.0, 0.0)), float(given.get("focal", 1.0))
    K = _array(given.get("cameraMatrix", [[f, 0, cx], [0, f, cy], [0, 0, 1]]), "cameraMatrix")
    x1, x2 = (_points_of(given[name], name) for name in ("points1", "points2"))
    retval, R, t, mask, _ = opencv.recoverPose(given["E"], x1, x2, K, distanceThresh=FARTHEST, mask=given.get("mask"))
    _put(R, given.get("R"))
    _put(t, given.get("t"))
    return retval, R, t, mask


def _preset(
    method: Any, threshold: float | int, confidence: float | int | None, iterations: int | None
) -> tuple[str, dict[str, Any]]:
    """The preset of a flag and its options. Raises TypeError or ValueError where there is none."""
    if not isinstance(method, int | np.integer):
        kind = type(method).__name__
        raise TypeError(f"method is a {kind}; UsacParams are of OpenCV's own search: call its function")
    method = int(method)
    if method not in PRESETS:
        raise ValueError(f"method is {method}; it must be one of {sorted(PRESETS)}, OpenCV's RANSAC, LMEDS and USAC_*")
    options: dict[str, Any] = {} if PRESETS[method] == "lmeds" else {"inlier_threshold": float(threshold)}
    if confidence is not None:
        options["confidence"] = float(confidence)
    if iterations is not None:
        options["hypotheses"] = int(iterations)
    return PRESETS[method], options


def _in_pixels(points: list[Matrix], threshold: float, method: Any, src: Matrix | None = None) -> tuple[float, float]:
    """What makes pixels, in which presets search, of points in another unit, as of a camera of a focal length of 1, and
    the threshold in them, the usual one of LMedS, which takes none. 1 for pixels, and where the threshold is so wide
    that it is not of this unit. src: the other points of a homography, of another extent where these are in the unit of
    a plane: beside it a threshold that is unusual in pixels shows that unit."""
    lmeds = method == opencv.LMEDS
    threshold = USUAL_THRESHOLD if lmeds or threshold <= 0 else float(threshold)  # as OpenCV
    finite = [x[np.isfinite(x).all(1)] for x in (*points, *([] if src is None else [src]))]
    there = [x for x in finite[: len(points)] if len(x)]
    reach = max((float(np.abs(x).max()) for x in there), default=0.0)
    if reach > MAX_REACH_PX:  # also on a map, far from its origin
        reach = max(float(np.ptp(x, axis=0).max()) for x in there)
    scale = 1.0
    if reach > 0 and not MIN_PIXELS <= reach <= MAX_REACH_PX:
        scale = REACH_PX / reach if lmeds or threshold < reach / 10 else 1.0
    elif src is not None and all(map(len, finite)) and (lmeds or not MIN_THRESHOLD <= threshold <= MAX_THRESHOLD):
        to, of = (float(np.ptp(x, axis=0).max()) for x in finite)
        comparable = of < find.COMPARABLE * to and to < find.COMPARABLE * of
        scale = 1.0 if comparable else REACH_PX / reach if lmeds else USUAL_THRESHOLD / threshold
    return scale, threshold if lmeds else scale * threshold


def _deficient(x1: Matrix, x2: Matrix) -> bool:
    """Whether points (n, 2) leave more than one F: the rank of their equations is below eight."""
    a, b = ((x - x.mean(0)) / max(float(np.std(x)), 1e-300) for x in (x1, x2))
    h0, h1 = (np.c_[x, np.ones(len(x))] for x in (a, b))
    singular = np.linalg.svd((h1[:, :, None] * h0[:, None]).reshape(len(a), 9), compute_uv=False)
    return len(singular) < 8 or not singular[7] > RANK * singular[0]


def _result(estimate: Estimate, matrix: Any, mask: Mask | None) -> tuple[Matrix | None, Mask | None]:
    """A matrix whose last entry is 1, if it is not 0, and the mask."""
    if not bool(estimate.ok[0]):
        return None, _written(None, mask)
    M = np.asarray(matrix, np.float64).reshape(3, 3)
    last = M[2, 2] if abs(M[2, 2]) > np.finfo(float).eps * np.abs(M).max() else 1.0
    return M / last, _written(estimate.inliers[0].cpu().numpy().astype(np.uint8)[:, None], mask)


def _written(mask: Mask | None, out: Mask | None) -> Mask | None:
    """The mask, also written to what the caller gave: zeros where there is none."""
    _put(np.zeros(0, np.uint8) if mask is None else mask, out)
    return mask


def _put(value: Any, out: Any) -> None:
    """Write to an array that the caller gave: a value of its size, or zeros for an empty one."""
    if isinstance(out, np.ndarray) and (value.size == 0 or out.size == value.size):
        out[...] = value.reshape(out.shape) if value.size else 0


def __getattr__(name: str) -> Any:
    return getattr(opencv, name)


def _calibrated(
    points1: Any, points2: Any, arguments: tuple[Any, ...], named: dict[str, Any]
) -> tuple[Matrix, Matrix, Matrix, Matrix, dict[str, Any]]:
    """Points without distortion, the camera matrices, and the other arguments by name, of any form of OpenCV's."""
    x1, x2 = _points_of(points1, "points1"), _points_of(points2, "points2")
    first = arguments[0] if arguments else named.get("cameraMatrix", named.get("cameraMatrix1", 1.0))
    two = "cameraMatrix2" in named or (len(arguments) > 3 and np.shape(arguments[2]) == (3, 3))
    rest = ("method", "prob", "threshold", "maxIters", "mask")
    if np.shape(first) != (3, 3):
        names: tuple[str, ...] = ("focal", "pp", *rest)
    elif two:
        names = ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", *(n for n in rest if n != "maxIters"))
    else:
        names = ("cameraMatrix", *rest)
    given = {**dict(zip(names, arguments, strict=False)), **named}
    if len(arguments) > len(names) or given.keys() - set(names):
        raise TypeError(f"findEssentialMat takes points1, points2, {', '.join(names)} in this form")
    if np.shape(first) != (3, 3):
        (cx, cy), f = given.get("pp", (0.0, 0.0)), float(given.get("focal", 1.0))
        K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
        return x1, x2, K, K, given
    if not two:
        K = _array(given["cameraMatrix"], "cameraMatrix")
        return x1, x2, K, K, given
    Ks = [_array(given[name], name) for name in ("cameraMatrix1", "cameraMatrix2")]
    for i, x in enumerate((x1, x2), start=1):
        bent = given.get(f"distCoeffs{i}")
        if bent is not None and np.any(bent):
            x[:] = _undistorted(x[:, None], Ks[i - 1], _array(bent, f"distCoeffs{i}"))[:, 0]
    return x1, x2, Ks[0], Ks[1], given


def _undistorted(x: Any, K: Matrix, bent: Matrix) -> Any:
    """Points (n, 1, 2) without distortion, iterated to the end and not for OpenCV's five steps."""
    if hasattr(opencv, "undistortPointsIter"):  # before OpenCV 5
        return opencv.undistortPointsIter(x, K, bent, None, K, TO_THE_END)
    return opencv.undistortPoints(x, K, bent, None, None, K, TO_THE_END)


def _array(value: Any, name: str) -> Matrix:
    """A copy in float64 of real numbers. Raises TypeError or ValueError, naming the argument, for anything else."""
    return as_tensor(value, name).detach().cpu().double().clone().numpy()


def _points_of(points: Any, name: str) -> Matrix:
    """Points (N, 2) of any form that OpenCV takes, a copy in float64. Raises ValueError for another."""
    array = _array(points, name)
    if array.ndim == 3 and 1 in array.shape[:2]:
        array = array.reshape(-1, array.shape[2])
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"{name} has shape {array.shape}; it must be (N, 2), (N, 1, 2) or (1, N, 2), or homogeneous")
    return array if array.shape[1] == 2 else array[:, :2] / array[:, 2:]
