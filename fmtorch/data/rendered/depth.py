"""How far away the points of a rendered photograph are: the scene is built anew and its rays are cast."""

from __future__ import annotations

import functools
import threading

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.rendered.generate import Task, build
from fmtorch.data.rendered.raycast import Geometry, Matrix

_SCENES = 2  # that each thread keeps, some 100 MB each: pairs of one scene follow one another
_PHOTOGRAPHS = 48  # whose visible pieces each thread keeps, some 2 MB each


def depth_at(task: Task, number: int, points: Matrix) -> Matrix:
    """Depth (n,) in metres along the axis of photograph `number` of a scene, at points (n, 2) in pixels.

    The depth of the plane that the nearest pixel's ray meets first, at the point itself. NaN where that ray meets
    nothing, and outside the photograph. What moves is where it was when this photograph was taken: each shot is cast
    against the surfaces of its own light. Of a long exposure it is the depth from the camera of the ground truth.
    """
    piece, inverse = _recent.visible(task, number)
    h, w = piece.shape
    column, row = np.round(np.nan_to_num(points, nan=-1.0)).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
    met = np.where(inside, piece[np.where(inside, row, 0), np.where(inside, column, 0)], -1)
    form = inverse[met]
    inverse_depth = form[:, 0] * points[:, 0] + form[:, 1] * points[:, 1] + form[:, 2]
    known = (met >= 0) & (inverse_depth > 0)
    return np.where(known, 1 / np.where(known, inverse_depth, 1.0), np.nan)


class _Recent(threading.local):
    """The scenes and photographs that a thread has asked for last; they go with the thread."""

    def __init__(self) -> None:
        self.scene = functools.lru_cache(maxsize=_SCENES)(build)
        self.visible = functools.lru_cache(maxsize=_PHOTOGRAPHS)(self._visible)

    def _visible(self, task: Task, number: int) -> tuple[NDArray[np.int32], Matrix]:
        """Per pixel (h, w) the piece that is met (-1: none), and of each piece (n, 3) the form of its 1 / depth."""
        scene = self.scene(task)
        shot = scene.shots[number]
        hits = Geometry(scene.surfaces[shot.light]).look(shot.camera)
        return hits.piece, hits.inverse[:, 2].copy()


_recent = _Recent()
