"""The same points found independently in photographs of one rendered scene: changes of viewpoint on real depth.

A homography warps a photograph as if it were a plane. Here surfaces move against each other, hide each other and are
lit anew; where a point of one photograph is in another is known from the scene's geometry.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fmtorch.scenes.camera import Camera
from fmtorch.scenes.generate import FAMILIES, Plan, Task, build, draw, seeds
from fmtorch.scenes.raycast import Geometry
from fmtorch.training.correspondences import (
    SAME_PLACE,
    Tolerance,
    cut_context,
    detect,
    distinct,
    near,
    same_point,
    sorted_by_point,
)
from fmtorch.training.keypoints import Keypoints
from fmtorch.training.warps import Grey, Matrix, change_camera, change_light, grey_of

FLAT = 0.01  # of inverse depth: how far it may bend within a sigma of a keypoint, which else is on an edge of depth
HIDDEN = 0.02  # of depth: a point farther behind what a photograph shows is hidden in it


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """A photograph, its camera, the inverse of the depth at its pixels (0: nothing is there), and its keypoints."""

    image: Grey
    camera: Camera
    inverse_depth: Matrix
    keypoints: Keypoints


def training_scenes(count: int, views: int, seed: int) -> list[Task]:
    """`count` scenes of each family of the training side, with so many photographs each."""
    plan = Plan(count, views, 0)
    return [Task(family, "train", number, seed, plan) for family in FAMILIES for number in range(count)]


def patches_of_scene(
    task: Task, rng: np.random.Generator, *, points: int, tolerance: Tolerance
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """As `corresponding_patches`, of the photographs of a scene: patches and the point that each shows."""
    views = views_of_scene(task, rng, points=points)
    owners = linked(views, tolerance)
    patches = [cut_context(view.image, view.keypoints[o >= 0]) for view, o in zip(views, owners, strict=True)]
    return sorted_by_point(patches, [owner[owner >= 0] for owner in owners])


def views_of_scene(task: Task, rng: np.random.Generator, *, points: int) -> list[View]:
    """The photographs of a scene in changed light, with their depth and the strongest `points` of each detector."""
    scene = build(task)
    shots = scene.shots[: task.plan.shots]
    geometry = [Geometry(surfaces) for surfaces in scene.surfaces]
    views = []
    for shot, picture in zip(shots, draw(scene, seeds(task)), strict=False):
        image = change_camera(rng, change_light(rng, grey_of(rng, picture)))
        with np.errstate(divide="ignore"):
            inverse_depth = 1 / geometry[shot.light].depth_map(shot.camera)
        views.append(View(image, shot.camera, inverse_depth, detect(image, points)))
    return views


def linked(views: Sequence[View], tolerance: Tolerance) -> list[NDArray[np.int64]]:
    """For every keypoint of every view the point that it shows, -1 for none.

    Each view in turn gives points: its keypoints that show none yet and are not near another. Those of later views that
    fall on one of them, as seen from there, show it.
    """
    owners = [np.full(len(view.keypoints), -1) for view in views]
    anchors: list[NDArray[np.int64]] = []
    total = 0
    for r, reference in enumerate(views):
        free = owners[r] < 0
        for earlier, chosen in zip(views, anchors, strict=False):
            there, visible = transferred(earlier.keypoints[chosen], earlier, reference)
            _, taken, _ = near(there[visible], reference.keypoints, SAME_PLACE)
            free[taken] = False
        candidates = np.flatnonzero(free)
        mine = candidates[distinct(reference.keypoints[candidates])]
        anchors.append(mine)
        owners[r][mine] = total + np.arange(len(mine))
        for v in range(r + 1, len(views)):
            todo = np.flatnonzero(owners[v] < 0)
            there, visible = transferred(views[v].keypoints[todo], views[v], reference)
            shown = same_point(reference.keypoints[mine], there[visible], tolerance)
            owners[v][todo[visible]] = np.where(shown >= 0, total + shown, -1)
        total += len(mine)
    return owners


def transferred(keypoints: Keypoints, source: View, target: View) -> tuple[Keypoints, NDArray[np.bool_]]:
    """Where keypoints of one view are in another, with scale and orientation as seen there; and which are seen there.

    Not seen is what lies on an edge of depth, outside the other photograph, or behind what it shows.
    """
    x = keypoints[:, :2]
    pixel, middle, slope, seen = local_depth(keypoints, source)

    def there(shift: tuple[float, float]) -> tuple[Matrix, Matrix]:
        moved = x + np.array(shift)
        depth = 1 / np.where(seen, middle + (slope * (moved - pixel)).sum(1), 1.0)
        rays = np.c_[moved, np.ones(len(x))] @ np.linalg.inv(source.camera.K).T
        return target.camera.project((rays * depth[:, None] - source.camera.t) @ source.camera.R)

    with np.errstate(divide="ignore", invalid="ignore"):
        centre, depth = there((0.0, 0.0))
        A = np.stack([there((0.5, 0.0))[0] - there((-0.5, 0.0))[0], there((0.0, 0.5))[0] - there((0.0, -0.5))[0]], -1)
        seen &= (depth > 0) & np.isfinite(centre).all(1) & np.isfinite(A).all((1, 2))
    centre, A = np.where(seen[:, None], centre, 0.0), np.where(seen[:, None, None], A, np.eye(2))
    h, w = target.inverse_depth.shape
    column, row = (np.round(centre[:, i]).astype(int) for i in (0, 1))
    seen &= (column >= 0) & (column < w) & (row >= 0) & (row < h)
    shown = target.inverse_depth[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    seen &= np.abs(depth * shown - 1) <= HIDDEN
    direction = A @ np.stack([np.cos(keypoints[:, 3]), np.sin(keypoints[:, 3])], -1)[..., None]
    sigma = keypoints[:, 2] * np.sqrt(np.abs(np.linalg.det(A)))
    return np.c_[centre, sigma, np.arctan2(direction[:, 1, 0], direction[:, 0, 0])], seen


def local_depth(keypoints: Keypoints, view: View) -> tuple[NDArray[np.int64], Matrix, Matrix, NDArray[np.bool_]]:
    """The plane that a view shows about each keypoint, as the linear form of its inverse depth.

    Returns the nearest pixels (n, 2), the inverse depth there (n,), its slope (n, 2), and which keypoints lie on a
    plane at all (n,): not those on an edge of depth, near the border or where nothing is.
    """
    x, inverse = keypoints[:, :2], view.inverse_depth
    h, w = inverse.shape
    column, row = (np.clip(np.round(x[:, i]).astype(int), 0, side - 1) for i, side in ((0, w), (1, h)))
    reach = np.ceil(keypoints[:, 2]).astype(int)
    sides = [
        inverse[np.clip(row + dy * reach, 0, h - 1), np.clip(column + dx * reach, 0, w - 1)]
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1))
    ]
    middle = inverse[row, column]
    slope = np.stack([(sides[1] - sides[0]) / (2 * reach), (sides[3] - sides[2]) / (2 * reach)], 1)
    bend = np.maximum(np.abs(sides[0] + sides[1] - 2 * middle), np.abs(sides[2] + sides[3] - 2 * middle))
    inside = (np.minimum(x[:, 0], x[:, 1]) >= reach) & (x[:, 0] < w - reach) & (x[:, 1] < h - reach)
    return np.c_[column, row], middle, slope, inside & (middle > 0) & (bend <= FLAT * middle)


def draw_patches(job: tuple[Task, tuple[int, int], int, Tolerance]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """What a worker does: one scene's patches."""
    task, seed, points, tolerance = job
    cv2.setNumThreads(1)
    return patches_of_scene(task, np.random.default_rng(seed), points=points, tolerance=tolerance)
