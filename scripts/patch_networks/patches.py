"""Training patches: the same points found independently in several views of a photograph or of a rendered scene.

A photograph is seen as a plane. In rendered scenes surfaces move against each other, hide each other and are lit anew.
Where a point of one view is in another is known from the geometry. Both give tracks, whose viewing angles say how hard
it is to match two patches of a point (Luo et al., GeoDesc, ECCV 2018, section 3.3).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.features import SIFT, DominantGradient, HessianDetector, ImagePyramid
from fmtorch.features.frames import FRAME_SIGMAS
from fmtorch.scenes.dataset import FAMILIES, Plan, Task, build, draw, seeds
from fmtorch.scenes.raycast import Camera, Geometry
from fmtorch.training import planes
from fmtorch.training.planes import Grey, Matrix, PlaneViews, warp

CONTEXT_SIZE = 64  # pixels of a stored patch's side: the middle 32 are the frame, of half side `FRAME_SIGMAS` sigma
FLAT = 0.01  # of inverse depth: how far it may bend within a sigma of a keypoint, which else is on an edge of depth
HIDDEN = 0.02  # of depth: a point farther behind what a view shows is hidden in it
INTERSECTION_SIGMA, INCIDENCE_SIGMA = 15.0, 20.0  # degrees, sigma_1 and sigma_2 of GeoDesc, section 3.3

Indices = NDArray[np.int64]
Keypoints = Matrix  # (n, 4): x, y, sigma in pixels, angle in radians, x axis towards y axis


class Part(NamedTuple):
    """Patches of points that two or more views of a source show, point after point.

    patches: (m, CONTEXT_SIZE, CONTEXT_SIZE). point, view: (m,) the point that each shows, and in which view. rays:
    (m, 3) unit directions from the surface to the camera, in the world. incidence: (m,) degrees between ray and surface
    normal, NaN where it is not known.
    """

    patches: NDArray[np.uint8]
    point: Indices
    view: Indices
    rays: NDArray[np.float32]
    incidence: NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """When keypoints of two views are the same point: distance in sigmas, ratio of scales, angle in degrees.

    Within these bounds a detector's error in position, scale and orientation stays in the patches.
    """

    distance: float = 0.6
    scale: float = 1.35
    angle: float = 25.0


SAME_PLACE = Tolerance(distance=1.0, scale=1.6, angle=45.0)  # within it two points would be false negatives


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """A view, its camera, the inverse of the depth at its pixels (0: nothing is there), and its keypoints."""

    image: Grey
    camera: Camera
    inverse_depth: Matrix
    keypoints: Keypoints


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


def distinct(keypoints: Keypoints) -> Indices:
    """Indices of keypoints without those that nearly repeat an earlier one: they would be false negatives."""
    i, j, _ = near(keypoints, keypoints, SAME_PLACE)
    kept = np.ones(len(keypoints), bool)
    for earlier, later in zip(i, j, strict=True):
        if earlier < later and kept[earlier]:
            kept[later] = False
    return np.flatnonzero(kept)


def same_point(anchors: Keypoints, detected: Keypoints, tolerance: Tolerance) -> Indices:
    """For each detected keypoint its anchor or -1; pairs are taken in the order of their cost, each keypoint once."""
    owner, taken = np.full(len(detected), -1), np.zeros(len(anchors), bool)
    i, j, cost = near(anchors, detected, tolerance)
    for k in np.argsort(cost, kind="stable"):
        if not taken[i[k]] and owner[j[k]] < 0:
            owner[j[k]], taken[i[k]] = i[k], True
    return owner


def moved(keypoints: Keypoints, centre: Matrix, A: Matrix) -> Keypoints:
    """Keypoints at other places (n, 2), with scale and orientation as linear maps (n, 2, 2) change them."""
    direction = A @ np.stack([np.cos(keypoints[:, 3]), np.sin(keypoints[:, 3])], -1)[..., None]
    sigma = keypoints[:, 2] * np.sqrt(np.abs(np.linalg.det(A)))
    there: Keypoints = np.c_[centre, sigma, np.arctan2(direction[:, 1, 0], direction[:, 0, 0])]
    return there


def training_scenes(count: int, views: int, seed: int) -> list[Task]:
    """`count` scenes of each family of the training side, with so many views each."""
    plan = Plan(count, views, 0)
    return [Task(family, "train", number, seed, plan) for family in FAMILIES for number in range(count)]


def views_of_scene(task: Task, rng: np.random.Generator, points: int) -> list[View]:
    """The views of a rendered scene in changed light, with the strongest `points` of each detector."""
    scene = build(task)
    geometry = [Geometry(surfaces) for surfaces in scene.surfaces]
    views = []
    for shot, picture in zip(scene.shots[: task.plan.shots], draw(scene, seeds(task)), strict=False):
        image = planes.change_camera(rng, planes.change_light(rng, planes.grey_of(rng, picture)))
        with np.errstate(divide="ignore"):
            inverse_depth = 1 / geometry[shot.light].depth_map(shot.camera)
        views.append(View(image, shot.camera, inverse_depth, detect(image, points)))
    return views


def views_of_plane(image: NDArray[np.uint8], rng: np.random.Generator, limits: PlaneViews, points: int) -> list[View]:
    """Views of an RGB or grey photograph as a plane, in changed light, with the strongest `points` of each detector."""
    grey = planes.grey_of(rng, image)
    views = []
    for _ in range(limits.views):
        camera = planes.random_camera(rng, grey.shape[:2], limits)
        picture = warp(planes.change_light(rng, grey), planes.plane_homography(camera, grey.shape[:2]), camera.size)
        picture = planes.change_camera(rng, picture)
        pixels = np.stack(np.indices(camera.size)[::-1], -1).reshape(-1, 2).astype(np.float64)
        inverse_depth = np.nan_to_num(1 / planes.plane_depth(camera, pixels)).reshape(camera.size)
        views.append(View(picture, camera, inverse_depth, detect(picture, points)))
    return views


def tracks_of_views(views: Sequence[View], tolerance: Tolerance) -> Part:
    """The patches of the points that two or more views show."""
    parts = []
    for i, (view, owner) in enumerate(zip(views, linked(views, tolerance), strict=True)):
        shown = np.flatnonzero(owner >= 0)
        keypoints = view.keypoints[shown]
        rays, incidence = (angles.astype(np.float32) for angles in rays_and_incidence(keypoints, view))
        parts.append(Part(cut(view.image, keypoints), owner[shown], np.full(len(shown), i), rays, incidence))
    every = Part(*map(np.concatenate, zip(*parts, strict=True)))
    several = np.bincount(every.point) >= 2
    kept = np.flatnonzero(several[every.point])
    order = kept[np.argsort(every.point[kept], kind="stable")]
    every = Part(*(column[order] for column in every))
    return every._replace(point=(np.cumsum(several) - 1)[every.point])


def linked(views: Sequence[View], tolerance: Tolerance) -> list[Indices]:
    """For every keypoint of every view the point that it shows, -1 for none.

    Each view in turn gives points: its keypoints that show none yet and are not near another. Those of later views that
    fall on one of them, as seen from there, show it.
    """
    owners = [np.full(len(view.keypoints), -1) for view in views]
    anchors: list[Indices] = []
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

    Not seen is what lies on an edge of depth, outside the other view, or behind what it shows.
    """
    x = keypoints[:, :2]
    pixel, middle, slope, seen = local_depth(keypoints, source)

    def there(*shift: float) -> tuple[Matrix, Matrix]:
        shifted = x + np.array(shift)
        depth = 1 / np.where(seen, middle + (slope * (shifted - pixel)).sum(1), 1.0)
        rays = np.c_[shifted, np.ones(len(x))] @ np.linalg.inv(source.camera.K).T
        return target.camera.project((rays * depth[:, None] - source.camera.t) @ source.camera.R)

    with np.errstate(divide="ignore", invalid="ignore"):
        centre, depth = there(0.0, 0.0)
        A = np.stack([there(0.5, 0.0)[0] - there(-0.5, 0.0)[0], there(0.0, 0.5)[0] - there(0.0, -0.5)[0]], -1)
        seen &= (depth > 0) & np.isfinite(centre).all(1) & np.isfinite(A).all((1, 2))
    centre, A = np.where(seen[:, None], centre, 0.0), np.where(seen[:, None, None], A, np.eye(2))
    h, w = target.inverse_depth.shape
    column, row = np.round(centre).astype(int).T
    seen &= (column >= 0) & (column < w) & (row >= 0) & (row < h)
    shown = target.inverse_depth[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    seen &= np.abs(depth * shown - 1) <= HIDDEN
    return moved(keypoints, centre, A), seen


def local_depth(keypoints: Keypoints, view: View) -> tuple[Indices, Matrix, Matrix, NDArray[np.bool_]]:
    """The plane that a view shows about each keypoint, as the linear form of its inverse depth.

    Returns the nearest pixels (n, 2), the inverse depth there (n,), its slope (n, 2), and which keypoints lie on a
    plane at all (n,): not those on an edge of depth, near the border or where nothing is.
    """
    x, inverse = keypoints[:, :2], view.inverse_depth
    h, w = inverse.shape
    column, row = (np.clip(np.round(x[:, i]).astype(int), 0, side - 1) for i, side in ((0, w), (1, h)))
    reach = np.ceil(keypoints[:, 2]).astype(int)
    left, right, above, below = (
        inverse[np.clip(row + dy * reach, 0, h - 1), np.clip(column + dx * reach, 0, w - 1)]
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1))
    )
    middle = inverse[row, column]
    slope = np.stack([right - left, below - above], 1) / (2 * reach[:, None])
    bend = np.maximum(np.abs(left + right - 2 * middle), np.abs(above + below - 2 * middle))
    inside = (np.minimum(x[:, 0], x[:, 1]) >= reach) & (x[:, 0] < w - reach) & (x[:, 1] < h - reach)
    return np.c_[column, row], middle, slope, inside & (middle > 0) & (bend <= FLAT * middle)


def rays_and_incidence(keypoints: Keypoints, view: View) -> tuple[Matrix, Matrix]:
    """Of keypoints (n, 4) of a view the directions from the surface to the camera and the incidence angles.

    The normal is that of the plane that the depth shows about the keypoint: where the inverse depth is f^T (x, y, 1) in
    pixels, it is K^T f.

    Returns unit vectors (n, 3) in the world, and the angles (n,) in degrees between them and the normal, in [0, 90];
    NaN where the depth is not that of a plane.
    """
    pixel, middle, slope, flat = local_depth(keypoints, view)
    normals = np.c_[slope, middle - (slope * pixel).sum(1)] @ view.camera.K
    rays = np.c_[keypoints[:, :2], np.ones(len(keypoints))] @ np.linalg.inv(view.camera.K).T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (normals * rays).sum(1) / np.linalg.norm(normals, axis=1)
    incidence = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
    return -rays @ view.camera.R, np.where(flat, incidence, np.nan)


def patch_similarity(rays0: Matrix, rays1: Matrix, incidence0: Matrix, incidence1: Matrix) -> Matrix:
    """S_patch (section 3.3): g(intersection angle, 15 degrees) g(difference of incidence angles, 20 degrees).

    g(a, s) = exp(-a^2 / (2 s^2)). The intersection angle is that between the two viewing rays at the point, the
    incidence angles are those between ray and surface normal.

    Args:
        rays0, rays1: unit directions (n, 3) from the point to each camera.
        incidence0, incidence1: degrees (n,).

    Returns similarities (n,) in [0, 1]; 1 for the same viewpoint.
    """
    cross = np.linalg.norm(np.cross(rays0, rays1), axis=1)
    intersection = np.degrees(np.arctan2(cross, (rays0 * rays1).sum(1))).astype(np.float64)
    difference = (incidence0 - incidence1).astype(np.float64)
    similarity: Matrix = np.exp(-((intersection / INTERSECTION_SIGMA) ** 2 + (difference / INCIDENCE_SIGMA) ** 2) / 2)
    return similarity
