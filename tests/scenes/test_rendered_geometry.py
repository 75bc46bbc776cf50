"""The ray-caster draws surfaces where the cameras say they are."""

import numpy as np
import pytest

from fmtorch.scenes import FAMILIES, Camera, Plan, Task, build, calibration, fundamental, look_at, relative_pose
from fmtorch.scenes.light import Light, Stage
from fmtorch.scenes.raycast import Geometry
from fmtorch.scenes.surfaces import Surfaces, Texture, vec
from tests.reference.rendering import colour

SIZE = (120, 160)


def camera(
    x: float, y: float, z: float, target: tuple[float, float, float] = (0.0, 0.0, 1.0), focal: float = 150.0
) -> Camera:
    return look_at(calibration(focal, SIZE), SIZE, (x, y, z), target, roll=0.1 * x)


def points_seen(geometry: Geometry, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) whose ray meets a surface, and the world points (n, 3) that they see, exactly."""
    depth = geometry.depth_map(camera)
    y, x = np.nonzero(np.isfinite(depth))
    pixel = np.stack([x, y], -1).astype(np.float64)
    rays = np.column_stack([pixel, np.ones(len(pixel))]) @ np.linalg.inv(camera.K).T
    return pixel, (rays * depth[y, x, None] - camera.t) @ camera.R


def test_look_at_is_a_rotation_that_centres_its_target() -> None:
    c = camera(1.0, -4.0, 1.5)
    np.testing.assert_allclose(c.R @ c.R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(c.R) == pytest.approx(1.0)
    x, depth = c.project(np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(x[0], [(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2], atol=1e-10)
    assert depth[0] == pytest.approx(np.linalg.norm(c.centre - [0, 0, 1]))
    # Up in the world is up in an upright image: smaller y.
    upright = camera(0.0, -4.0, 1.0)
    assert upright.project(np.array([[0.0, 0.0, 2.0]]))[0][0, 1] < upright.project(np.array([[0.0, 0.0, 0.0]]))[0][0, 1]


def test_relative_pose_and_fundamental_agree_with_projected_points() -> None:
    c0, c1 = camera(-1, -4, 1.2), camera(1.5, -3.5, 1.8, focal=210.0)
    X = np.random.default_rng(0).uniform(-1, 1, (200, 3)) + vec(0, 0, 1)
    R, t = relative_pose(c0, c1)
    X0, X1 = X @ c0.R.T + c0.t, X @ c1.R.T + c1.t
    np.testing.assert_allclose(X0 @ R.T + t, X1, atol=1e-12)
    F = fundamental(c0, c1)
    assert np.linalg.norm(F) == pytest.approx(1.0)
    assert line_distance(F, c0.project(X)[0], c1.project(X)[0]).max() < 1e-9


def line_distance(F: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """Larger distance in pixels of the points to the epipolar lines of each other."""
    h0, h1 = np.column_stack([x0, np.ones(len(x0))]), np.column_stack([x1, np.ones(len(x1))])
    l1, l0 = h0 @ F.T, h1 @ F
    error = np.abs((h1 * l1).sum(1))
    return np.maximum(error / np.hypot(l1[:, 0], l1[:, 1]), error / np.hypot(l0[:, 0], l0[:, 1]))


@pytest.mark.parametrize("family", FAMILIES)
def test_what_a_pixel_sees_lies_on_its_epipolar_line(family: str) -> None:
    scene = build(Task(family, "train", 0, 3, Plan(1, 3, 2, 0.1)))
    c0, c1 = scene.shots[0].camera, scene.shots[1].camera
    pixel, X = points_seen(Geometry(scene.surfaces[0]), c0)
    assert len(pixel) > 0.3 * c0.size[0] * c0.size[1]
    np.testing.assert_allclose(c0.project(X)[0], pixel, atol=1e-8)
    ahead = X @ c1.R[2] + c1.t[2] > 0.1
    assert line_distance(fundamental(c0, c1), pixel[ahead], c1.project(X[ahead])[0]).max() < 1e-6


def test_a_mark_is_drawn_where_it_projects() -> None:
    """The centroid of a small bright disc on a dark wall is at its projection, to a hundredth of a pixel."""
    surfaces = Surfaces()
    size = 1024
    y, x = np.mgrid[:size, :size]
    u, v = 700.0, 420.0
    disc = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 12.0**2))
    number = surfaces.texture(np.repeat((disc + 0.5).astype(np.uint8)[..., None], 3, axis=2))
    surfaces.quad(vec(-2, 0, 3), vec(4, 0, 0), vec(0, 0, -4), number)
    stage = Stage(
        Geometry(surfaces), Light((0, -1, 0.1), sun=(0.0, 0.0, 0.0), ground_shade=0), np.zeros((8, 16, 3), np.uint8)
    )
    c = camera(0.0, -5.0, 1.0, (0.0, 0.0, 1.0))  # frontal: no perspective shift of the centroid
    image = stage.radiance(c, (0.0, 0.0))[..., 0].astype(np.float64)
    yy, xx = np.mgrid[: SIZE[0], : SIZE[1]]
    centroid = np.array([(image * xx).sum(), (image * yy).sum()]) / image.sum()
    mark = vec(-2 + 4 * (u + 0.5) / size, 0, 3 - 4 * (v + 0.5) / size)
    np.testing.assert_allclose(centroid, c.project(mark[None])[0][0], atol=0.02)


def test_textures_keep_their_mean_when_they_shrink_and_do_not_alias() -> None:
    picture = np.zeros((256, 256, 3), np.uint8)
    picture[:, ::2] = 255  # the finest stripes
    texture = Texture(picture)
    u = np.random.default_rng(0).random(500).astype(np.float32)
    far = colour(texture, u, u[::-1].copy(), np.full(500, 5.0, np.float32))
    assert far.mean() == pytest.approx(0.5, abs=0.01)
    assert far.std() < 0.01
