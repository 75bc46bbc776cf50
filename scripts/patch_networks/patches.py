"""Training patches: the same points found independently in several views of a photograph as a plane.

Where a point of one view is in another is known from the cameras. The viewing angles of its patches say how hard it is
to match two of them (Luo et al., GeoDesc, ECCV 2018, section 3.3).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.features import SIFT, DominantGradient, HessianDetector, ImagePyramid
from fmtorch.features.frames import FRAME_SIGMAS
from fmtorch.scenes.raycast import Camera
from fmtorch.training import planes
from fmtorch.training.planes import Grey, Matrix, PlaneViews

CONTEXT_SIZE = 64  # pixels of a stored patch's side: the middle 32 are the frame, of half side `FRAME_SIGMAS` sigma
INTERSECTION_SIGMA, INCIDENCE_SIGMA = 15.0, 20.0  # degrees, sigma_1 and sigma_2 of GeoDesc, section 3.3

Indices = NDArray[np.int64]
Keypoints = Matrix  # (n, 4): x, y, sigma in pixels, angle in radians, x axis towards y axis


class Part(NamedTuple):
    """Patches of points that two or more views of a photograph show, point after point.
    patches: (m, CONTEXT_SIZE, CONTEXT_SIZE). point, view: (m,) the point that each shows, and in which view. rays: (m,
    3) unit directions from the plane to the camera, in the world. incidence: (m,) degrees between ray and normal."""

    patches: NDArray[np.uint8]
    point: Indices
    view: Indices
    rays: NDArray[np.float32]
    incidence: NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """When keypoints of two views are the same point: distance in sigmas, ratio of scales, angle in degrees.
    Within these bounds a detector's error in position, scale and orientation stays in the patches."""

    distance: float = 0.6
    scale: float = 1.35
    angle: float = 25.0


SAME_PLACE = Tolerance(distance=1.0, scale=1.6, angle=45.0)  # within it two points would be false negatives


class View(NamedTuple):
    """A view, its camera, its keypoints, and where they are in the photograph, with scale and orientation there."""

    image: Grey
    camera: Camera
    keypoints: Keypoints
    there: Keypoints


def detect(image: Grey, count: int) -> Keypoints:
    """The strongest keypoints of DoG and of the determinant of the Hessian, `count` of each, with orientations."""
    dog, _ = SIFT(max_features=count, contrast_threshold=0.02).detect(image)
    blobs, _ = HessianDetector(max_features=count).detect(image)
    lafs = torch.cat([dog, DominantGradient()(ImagePyramid(image), blobs)]).double().numpy()
    sigma = np.hypot(lafs[:, 0, 0], lafs[:, 1, 0]) / FRAME_SIGMAS
    keypoints: Keypoints = np.c_[lafs[..., 2], sigma, np.arctan2(lafs[:, 1, 0], lafs[:, 0, 0])]
    return keypoints


def cut(image: Grey, keypoints: Keypoints) -> NDArray[np.uint8]:
    """Patches (n, CONTEXT_SIZE, CONTEXT_SIZE) of keypoints, turned to their orientation, without aliasing."""
    x, y, half, angle = keypoints.T * np.array([1, 1, FRAME_SIGMAS * CONTEXT_SIZE / 32, 1])[:, None]
    c, s = half * np.cos(angle), half * np.sin(angle)
    lafs = torch.from_numpy(np.stack([c, -s, x, s, c, y], -1).reshape(-1, 2, 3)).float()
    patches = 255 * ImagePyramid(image).extract(lafs, CONTEXT_SIZE)[:, 0]
    return patches.round().clamp(0, 255).to(torch.uint8).numpy()


def near(a: Keypoints, b: Keypoints, tolerance: Tolerance) -> tuple[Indices, Indices, Matrix]:
    """Pairs (indices of a and of b) within the tolerance, and each one's cost, 0 to 2; sigmas are those of `a`."""
    x, y = (np.asarray(a[:, None, k] - b[None, :, k], np.float32) for k in (0, 1))
    i, j = np.nonzero(x * x + y * y <= (tolerance.distance * a[:, 2, None]).astype(np.float32) ** 2)
    distance = np.hypot(a[i, 0] - b[j, 0], a[i, 1] - b[j, 1]) / a[i, 2]
    scale = np.abs(np.log(a[i, 2] / b[j, 2]))
    angle = np.degrees(np.abs((a[i, 3] - b[j, 3] + np.pi) % (2 * np.pi) - np.pi))
    fits = (scale <= np.log(tolerance.scale)) & (angle <= tolerance.angle)
    cost = distance / tolerance.distance + scale / np.log(tolerance.scale)
    return i[fits], j[fits], cost[fits]


def same_point(anchors: Keypoints, detected: Keypoints, tolerance: Tolerance) -> Indices:
    """For each detected keypoint its anchor or -1; pairs are taken in the order of their cost, each keypoint once."""
    owner, taken = np.full(len(detected), -1), np.zeros(len(anchors), bool)
    i, j, cost = near(anchors, detected, tolerance)
    for k in np.argsort(cost, kind="stable"):
        if not taken[i[k]] and owner[j[k]] < 0:
            owner[j[k]], taken[i[k]] = i[k], True
    return owner


def in_photograph(keypoints: Keypoints, H: Matrix) -> Keypoints:
    """Keypoints of a view at their places in the photograph, of which H is the homography to the view."""
    back: Matrix = np.asarray(np.linalg.inv(H), np.float64)
    place = np.c_[keypoints[:, :2], np.ones(len(keypoints))] @ back.T
    A = planes.local_affine(back, keypoints[:, :2])
    direction = A @ np.stack([np.cos(keypoints[:, 3]), np.sin(keypoints[:, 3])], -1)[..., None]
    sigma = keypoints[:, 2] * np.sqrt(np.abs(np.linalg.det(A)))
    there: Keypoints = np.c_[place[:, :2] / place[:, 2:], sigma, np.arctan2(direction[:, 1, 0], direction[:, 0, 0])]
    return there


def views_of(image: NDArray[np.uint8], rng: np.random.Generator, limits: PlaneViews, points: int) -> list[View]:
    """Views of an RGB or grey photograph as a plane, in changed light, with the strongest `points` of each detector.
    Keypoints where the plane shows the mirror image of the photograph, beyond its edges, are left out."""
    grey = planes.grey_of(rng, image)
    sides = np.array(grey.shape[::-1])
    views = []
    for _ in range(limits.views):
        camera = planes.random_camera(rng, grey.shape[:2], limits)
        H = planes.plane_homography(camera, grey.shape[:2])
        picture = planes.change_camera(rng, planes.warp(planes.change_light(rng, grey), H, camera.size))
        keypoints = detect(picture, points)
        there = in_photograph(keypoints, H)
        inside = ((there[:, :2] >= 0) & (there[:, :2] <= sides - 1)).all(1)
        views.append(View(picture, camera, keypoints[inside], there[inside]))
    return views


def tracks(views: Sequence[View], tolerance: Tolerance) -> Part:
    """The patches of the points that two or more views show."""
    parts = []
    for i, (view, owner) in enumerate(zip(views, linked([view.there for view in views], tolerance), strict=True)):
        shown = np.flatnonzero(owner >= 0)
        keypoints = view.keypoints[shown]
        rays, incidence = (angles.astype(np.float32) for angles in rays_and_incidence(keypoints, view.camera))
        parts.append(Part(cut(view.image, keypoints), owner[shown], np.full(len(shown), i), rays, incidence))
    every = Part(*map(np.concatenate, zip(*parts, strict=True)))
    several = np.bincount(every.point) >= 2
    kept = np.flatnonzero(several[every.point])
    order = kept[np.argsort(every.point[kept], kind="stable")]
    every = Part(*(column[order] for column in every))
    return every._replace(point=(np.cumsum(several) - 1)[every.point])


def linked(views: Sequence[Keypoints], tolerance: Tolerance) -> list[Indices]:
    """For every keypoint of every view, at its place in the photograph, the point that it shows, -1 for none.
    A keypoint shows a point of the views before, or where none is near becomes one; those that nearly repeat an earlier
    one of the same view are left out, since they would be false negatives."""
    owners, points = [], np.zeros((0, 4))
    for keypoints in views:
        owner = same_point(points, keypoints, tolerance)
        free = owner < 0
        free[near(points, keypoints, SAME_PLACE)[1]] = False
        for earlier, later in zip(*near(keypoints, keypoints, SAME_PLACE)[:2], strict=True):
            if earlier < later and free[earlier]:
                free[later] = False
        owner[free] = len(points) + np.arange(free.sum())
        owners.append(owner)
        points = np.r_[points, keypoints[free]]
    return owners


def rays_and_incidence(keypoints: Keypoints, camera: Camera) -> tuple[Matrix, Matrix]:
    """Unit directions (n, 3) from the plane z = 0 to its camera at z < 0, and degrees (n,) to its normal."""
    rays = np.c_[keypoints[:, :2], np.ones(len(keypoints))] @ np.linalg.inv(camera.K).T @ camera.R
    rays /= -np.linalg.norm(rays, axis=1, keepdims=True)
    return rays, np.degrees(np.arccos(np.clip(-rays[:, 2], 0.0, 1.0)))


def patch_similarity(rays0: Matrix, rays1: Matrix, incidence0: Matrix, incidence1: Matrix) -> Matrix:
    """S_patch (section 3.3): g(intersection angle, 15 degrees) g(difference of incidence angles, 20 degrees).

    g(a, s) = exp(-a^2 / (2 s^2)). The intersection angle is that between the two viewing rays at the point.

    Args:
        rays0, rays1: unit directions (n, 3) from the point to each camera.
        incidence0, incidence1: degrees (n,) between ray and surface normal.

    Returns similarities (n,) in [0, 1]; 1 for the same viewpoint.
    """
    cross = np.linalg.norm(np.cross(rays0, rays1), axis=1)
    intersection = np.degrees(np.arctan2(cross, (rays0 * rays1).sum(1))).astype(np.float64)
    difference = (incidence0 - incidence1).astype(np.float64)
    similarity: Matrix = np.exp(-((intersection / INTERSECTION_SIGMA) ** 2 + (difference / INCIDENCE_SIGMA) ** 2) / 2)
    return similarity
