"""The arguments of OpenCV's functions of two views, in all their forms."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


def calibrated(
    x1: Matrix, x2: Matrix, arguments: tuple[Any, ...], named: dict[str, Any]
) -> tuple[Matrix, Matrix, Matrix, Matrix, dict[str, Any]]:
    """Points without distortion, the camera matrices, and the other arguments by name, of any form of OpenCV's."""
    first = (
        arguments[0] if arguments else next((named[n] for n in ("cameraMatrix", "cameraMatrix1") if n in named), 1.0)
    )
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
        K = np.asarray(given["cameraMatrix"], np.float64)
        return x1, x2, K, K, given
    Ks = [np.asarray(given[f"cameraMatrix{i}"], np.float64) for i in (1, 2)]
    for i, x in enumerate((x1, x2), start=1):
        bent = given.get(f"distCoeffs{i}")
        if bent is not None and np.any(bent):
            x[:] = cv2.undistortPoints(x[:, None], Ks[i - 1], np.asarray(bent, np.float64), P=Ks[i - 1])[:, 0]
    return x1, x2, Ks[0], Ks[1], given


def points_of(points: Any, name: str) -> Matrix:
    """Points (N, 2) of any form that OpenCV takes, a copy in float64. Raises ValueError for another."""
    array = np.array(points, np.float64)
    if array.ndim == 3 and 1 in array.shape[:2]:
        array = array.reshape(-1, array.shape[2])
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name} has shape {array.shape}; it must be (N, 2), (N, 1, 2) or (1, N, 2)")
    return array
