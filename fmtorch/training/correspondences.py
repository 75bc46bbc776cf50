"""The same points found independently in several views of one photograph, and the patches around them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.features.frames import FRAME_SIGMAS
from fmtorch.training.keypoints import Keypoints, dog_keypoints, hessian_keypoints
from fmtorch.training.warps import (
    Grey,
    Matrix,
    ViewRange,
    apply,
    change_camera,
    change_light,
    grey_of,
    local_affine,
    random_homography,
    warp,
)

CONTEXT_SIZE = 64
"""Pixels of a stored patch's side: the middle 32 are the frame, of half side `FRAME_SIGMAS` sigma."""


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """When keypoints of two views are the same point: distance in sigmas, ratio of scales, angle in degrees.

    Within these bounds a detector's error in position, scale and orientation stays in the patches.
    """

    distance: float = 0.6
    scale: float = 1.35
    angle: float = 25.0


SAME_PLACE = Tolerance(distance=1.0, scale=1.6, angle=45.0)
"""Keypoints within it show nearly the same: they are never two points, or one would be the other's false negative."""


def corresponding_patches(
    image: NDArray[np.uint8],
    rng: np.random.Generator,
    *,
    views: int,
    points: int,
    limits: ViewRange,
    tolerance: Tolerance,
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Patches (m, CONTEXT_SIZE, CONTEXT_SIZE) of an RGB or grey image and the point (m,) that each shows.

    `views` random views are drawn; keypoints are detected in each on its own and those that fall on a keypoint of the
    first (up to `points` of each detector) become its patches. Every point has at least two patches.
    """
    patches, owners = [], []
    anchors: Keypoints = np.zeros((0, 4))
    for view in range(views):
        picture, H = _view(image, rng, limits, first=view == 0)
        detected = detect(picture, points if view == 0 else 4 * points)
        in_reference = _transfer(detected, np.asarray(np.linalg.inv(H), np.float64))
        if view == 0:
            kept = distinct(in_reference)
            anchors, detected = in_reference[kept], detected[kept]
            owner = np.arange(len(anchors))
        else:
            owner = same_point(anchors, in_reference, tolerance)
        mine = np.flatnonzero(owner >= 0)
        patches.append(cut_context(picture, detected[mine]))
        owners.append(owner[mine])
    return sorted_by_point(patches, owners)


def sorted_by_point(
    patches: Sequence[NDArray[np.uint8]], points: Sequence[NDArray[np.int64]]
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """The patches of points that have two or more, point after point, and the point of each, numbered anew."""
    order, point = in_order_of_points(np.concatenate(points))
    return np.concatenate(patches)[order], point


def in_order_of_points(point: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of what shows points that are shown twice or more, point after point, and the points, numbered anew."""
    several = np.bincount(point) >= 2
    kept = np.flatnonzero(several[point])
    order = kept[np.argsort(point[kept], kind="stable")]
    return order, (np.cumsum(several) - 1)[point[order]]


def cut_context(image: Grey, keypoints: Keypoints) -> NDArray[np.uint8]:
    """The patches (n, CONTEXT_SIZE, CONTEXT_SIZE) that are stored of keypoints."""
    return cut(image, keypoints, CONTEXT_SIZE, FRAME_SIGMAS * CONTEXT_SIZE / 32)


def cut(image: Grey, keypoints: Keypoints, size: int, sigmas: float) -> NDArray[np.uint8]:
    """Patches (n, size, size) turned to their orientation, half side `sigmas` sigma, without aliasing."""
    pyramid = [image]
    out = np.zeros((len(keypoints), size, size), np.uint8)
    for i, (x, y, sigma, angle) in enumerate(keypoints):
        step = 2 * sigmas * sigma / size  # pixels of the image per pixel of the patch
        level = max(0, round(np.log2(step)))
        while len(pyramid) <= level:
            pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), np.uint8))
        c, s = np.cos(angle) * step, np.sin(angle) * step
        A = np.array([[c, -s], [s, c]])
        centre = np.array([x, y]) - A @ np.full(2, (size - 1) / 2)
        cv2.warpAffine(
            pyramid[level], np.c_[A, centre] / 2**level, (size, size), dst=out[i],
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT_101,
        )  # fmt: skip
    return out


def _view(image: NDArray[np.uint8], rng: np.random.Generator, limits: ViewRange, first: bool) -> tuple[Grey, Matrix]:
    """A random view and the homography from the image to it; the first is the image itself in other light."""
    grey = grey_of(rng, image)
    if first:
        return change_light(rng, grey), np.eye(3)
    H, size = random_homography(rng, (grey.shape[0], grey.shape[1]), limits)
    return change_camera(rng, warp(change_light(rng, grey), H, size)), H


def detect(image: Grey, count: int) -> Keypoints:
    """The strongest DoG and Hessian keypoints, `count` of each."""
    return np.concatenate([dog_keypoints(image, count), hessian_keypoints(image, count)])


def _transfer(keypoints: Keypoints, H: Matrix) -> Keypoints:
    """Keypoints as a homography maps them: its derivative moves scale and orientation."""
    A = local_affine(H, keypoints[:, :2])
    sigma = keypoints[:, 2] * np.sqrt(np.abs(np.linalg.det(A)))
    direction = A @ np.stack([np.cos(keypoints[:, 3]), np.sin(keypoints[:, 3])], -1)[..., None]
    angle = np.arctan2(direction[:, 1, 0], direction[:, 0, 0])
    return np.asarray(np.c_[apply(H, keypoints[:, :2]), sigma, angle], np.float64)


def near(a: Keypoints, b: Keypoints, tolerance: Tolerance) -> tuple[NDArray[np.int64], NDArray[np.int64], Matrix]:
    """Pairs (indices of a and of b) within the tolerance, and each one's cost, 0 to 2; sigmas are those of `a`."""
    x, y = (np.asarray(a[:, None, k] - b[None, :, k], np.float32) for k in (0, 1))
    i, j = np.nonzero(x * x + y * y <= (tolerance.distance * a[:, 2, None]).astype(np.float32) ** 2)
    distance = np.hypot(a[i, 0] - b[j, 0], a[i, 1] - b[j, 1]) / a[i, 2]
    scale = np.abs(np.log(a[i, 2] / b[j, 2]))
    angle = np.degrees(np.abs((a[i, 3] - b[j, 3] + np.pi) % (2 * np.pi) - np.pi))
    fits = (scale <= np.log(tolerance.scale)) & (angle <= tolerance.angle)
    cost = distance / tolerance.distance + scale / np.log(tolerance.scale)
    return i[fits], j[fits], cost[fits]


def distinct(keypoints: Keypoints) -> NDArray[np.int64]:
    """Indices of keypoints without those that nearly repeat an earlier one: they would be false negatives."""
    i, j, _ = near(keypoints, keypoints, SAME_PLACE)
    kept = np.ones(len(keypoints), bool)
    for earlier, later in zip(i, j, strict=True):
        if earlier < later and kept[earlier]:
            kept[later] = False
    return np.flatnonzero(kept)


def same_point(anchors: Keypoints, detected: Keypoints, tolerance: Tolerance) -> NDArray[np.int64]:
    """For each found keypoint its anchor or -1; pairs are taken in the order of their cost, each keypoint once."""
    owner = np.full(len(detected), -1)
    taken = np.zeros(len(anchors), bool)
    i, j, cost = near(anchors, detected, tolerance)
    for k in np.argsort(cost, kind="stable"):
        if not taken[i[k]] and owner[j[k]] < 0:
            owner[j[k]], taken[i[k]] = i[k], True
    return owner
