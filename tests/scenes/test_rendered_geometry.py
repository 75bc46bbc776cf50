"""Geometry, depth and light of rendered scenes equal their definitions."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmtorch import scenes
from fmtorch.data import DepthDataset, load
from fmtorch.geometry import symmetric_max
from fmtorch.scenes.light import DrawnScene, Lens, Light, Shot, Stage, expose
from fmtorch.scenes.raycast import Geometry
from fmtorch.scenes.surfaces import Surfaces, Texture, vec
from tests.reference import rendering as reference
from tests.reference.labels import first_hit
from tests.reference.rendering import colour

SIZE = (120, 160)
KERNEL_SIZE = (90, 120)
DEPTH_SIZE = (60, 80)
WALL, SCREEN = 4.0, 2.5  # metres
SMALL = scenes.Plan(scenes=1, shots=2, pairs=1, scale=0.15)


def camera(x: float, y: float, z: float, target=(0.0, 0.0, 1.0), focal: float = 150.0) -> scenes.Camera:
    return scenes.look_at(scenes.calibration(focal, SIZE), SIZE, (x, y, z), target, roll=0.1 * x)


def points_seen(geometry: Geometry, camera: scenes.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) whose ray meets a surface, and the world points (n, 3) that they see, exactly."""
    hits, inverse = geometry.look(camera)
    y, x = np.nonzero(hits.piece >= 0)
    homogeneous = np.column_stack([x, y, np.ones(len(x))])
    depth = 1 / (inverse[hits.piece[y, x], 2] * homogeneous).sum(1)
    rays = homogeneous @ np.linalg.inv(camera.K).T
    return homogeneous[:, :2], (rays * depth[:, None] - camera.t) @ camera.R


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


@functools.cache
def built(family: str) -> DrawnScene:
    return scenes.build(scenes.Task(family, "train", 1, 5, scenes.Plan(1, 3, 2, 0.1)))


@pytest.mark.parametrize("family", scenes.FAMILIES)
def test_what_a_pixel_sees_lies_on_its_epipolar_line(family: str) -> None:
    scene = built(family)
    c0, c1 = scene.shots[0].camera, scene.shots[1].camera
    pixel, X = points_seen(Geometry(scene.surfaces[0]), c0)
    assert len(pixel) > 0.3 * c0.size[0] * c0.size[1]
    np.testing.assert_allclose(c0.project(X)[0], pixel, atol=1e-8)
    ahead = X @ c1.R[2] + c1.t[2] > 0.1
    assert symmetric_max(scenes.fundamental(c0, c1), pixel[ahead], c1.project(X[ahead])[0]).max() < 1e-6
    R, t = scenes.relative_pose(c0, c1)
    np.testing.assert_allclose((X @ c0.R.T + c0.t) @ R.T + t, X @ c1.R.T + c1.t, atol=1e-9)


def test_a_mark_is_drawn_where_it_projects() -> None:
    """The centroid of a small bright disc on a dark wall is at its projection, to a hundredth of a pixel."""
    surfaces = Surfaces()
    size = 1024
    y, x = np.mgrid[:size, :size]
    u, v = 700.0, 420.0
    disc = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 12.0**2))
    number = surfaces.texture(np.repeat((disc + 0.5).astype(np.uint8)[..., None], 3, axis=2))
    surfaces.quad(vec(-2, 0, 3), vec(4, 0, 0), vec(0, 0, -4), number)
    light = Light((0, -1, 0.1), sun=(0.0, 0.0, 0.0), ground_shade=0)
    stage = Stage(Geometry(surfaces), light, np.zeros((8, 16, 3), np.uint8))
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


def take_reference(patch: pytest.MonkeyPatch) -> None:
    geometries = list[Geometry]()
    cast = Geometry.cast

    def remembered(self: Geometry, *arguments: Any) -> Any:
        geometries.append(self)
        return cast(self, *arguments)

    patch.setattr(Geometry, "cast", remembered)
    patch.setattr(scenes.raycast, "cast_pieces", lambda pieces, _, *rest: reference.cast(geometries[-1], pieces, *rest))
    patch.setattr(Stage, "_shade", reference.shade)


def stages(surfaces: Surfaces, light: Light, sky: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> list[Stage]:
    built = [Stage(Geometry(surfaces), light, sky)]
    with monkeypatch.context() as patch:
        take_reference(patch)
        built.append(Stage(Geometry(surfaces), light, sky))
    np.testing.assert_array_equal(built[0].shadow, built[1].shadow)
    return built


def assert_equal_views(pair: list[Stage], camera: scenes.Camera, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Kernels and definitions meet the same pieces in the same places and draw the same picture; returns the pieces."""
    seen = [view(pair[0], camera)]
    with monkeypatch.context() as patch:
        take_reference(patch)
        seen.append(view(pair[1], camera))
    for compiled, expected in zip(*seen, strict=True):
        np.testing.assert_array_equal(compiled, expected)
    return seen[0][0]


def view(stage: Stage, camera: scenes.Camera) -> tuple[np.ndarray, ...]:
    """The pieces and places that the pixels see, their colours, and the photograph."""
    offset = (0.125, -0.375)
    hits, _ = stage.geometry.look(camera, offset)
    picture = expose(stage, [camera], Lens(), np.random.default_rng(0))
    return hits.piece, hits.s, hits.t, stage.radiance(camera, offset), picture


@pytest.mark.parametrize("family", scenes.FAMILIES)
def test_forms_draw_the_same_scenes(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = built(family)
    shots = [scene.shots[0], scene.shots[-1]]
    for light in {shot.light for shot in shots}:
        pair = stages(scene.surfaces[light], scene.lights[light], scene.sky, monkeypatch)
        for shot in shots:
            if shot.light == light:
                assert len(np.unique(assert_equal_views(pair, shot.camera, monkeypatch))) > 20


def random_world(rng: np.random.Generator) -> Surfaces:
    """Pieces of all kinds and sizes in all directions: edge-on, across the camera's plane, with holes."""
    surfaces = Surfaces()
    pictures = [rng.integers(0, 256, (int(h), int(w), c), dtype=np.uint8)
                for h, w, c in ((5, 6, 3), (64, 48, 3), (16, 16, 4), (33, 129, 4))]  # fmt: skip
    numbers = [surfaces.texture(picture) for picture in pictures]
    for k in range(60):
        corner, U, V = rng.normal(0, 2, (3, 3)) * rng.choice([0.01, 0.3, 1.0, 5.0])
        if k % 10 == 0:
            U[2] = V[2] = 0.0  # level
        uv = rng.normal(0, 1, (3, 2)) * rng.choice([0.01, 1.0, 40.0])
        normals = rng.normal(0, 1, (3, 3)) if k % 3 == 0 else None
        options = {"triangle": bool(k % 2), "normals": normals, "both_sides": bool(rng.integers(2))}
        surfaces.piece(corner, U, V, numbers[k % 4], uv, **options)
    return surfaces


@pytest.mark.parametrize("seed", range(2))
def test_forms_draw_the_same_random_worlds(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    sky = rng.integers(0, 256, (16, 32, 3), dtype=np.uint8)
    pair = stages(random_world(rng), Light((0.3, -0.5, 0.8), through_walls=bool(seed % 2)), sky, monkeypatch)
    for _ in range(3):
        eye, target = rng.normal(0, 3, (2, 3))
        K = scenes.calibration(80.0, KERNEL_SIZE)
        assert_equal_views(pair, scenes.look_at(K, KERNEL_SIZE, eye.tolist(), target.tolist()), monkeypatch)


def test_forms_draw_an_empty_view(monkeypatch: pytest.MonkeyPatch) -> None:
    surfaces = Surfaces()
    surfaces.quad(vec(0, 0, 0), vec(1, 0, 0), vec(0, 1, 0), surfaces.texture(np.zeros((8, 8, 3), np.uint8)))
    pair = stages(surfaces, Light((0.3, -0.5, 0.8)), np.full((8, 16, 3), 90, np.uint8), monkeypatch)
    camera = scenes.look_at(scenes.calibration(80.0, KERNEL_SIZE), KERNEL_SIZE, (0.0, 0.0, 5.0), (0.0, 1.0, 9.0))
    assert (assert_equal_views(pair, camera, monkeypatch) == -1).all()


def test_textures_too_small_to_shrink_are_refused() -> None:
    with pytest.raises(ValueError, match="4 x 9 pixels; each side must have at least 5"):
        Surfaces().texture(np.zeros((9, 4, 3), np.uint8))


def wall_and_screen(with_screen: bool) -> Surfaces:
    """A wall 3 m high in front of the origin, and a screen before its left half."""
    surfaces = Surfaces()
    grey = surfaces.texture(np.full((8, 8, 3), 128, np.uint8))
    surfaces.quad(vec(-9, WALL, 1.5), vec(18, 0, 0), vec(0, 0, -3), grey)
    if with_screen:
        surfaces.quad(vec(-9, SCREEN, 1.5), vec(9, 0, 0), vec(0, 0, -3), grey)
    return surfaces


@pytest.fixture
def staged(monkeypatch: pytest.MonkeyPatch) -> tuple[scenes.Task, scenes.Camera]:
    """A scene in which the screen stands only when the second photograph is taken."""
    camera = scenes.look_at(scenes.calibration(60.0, DEPTH_SIZE), DEPTH_SIZE, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    shots = [Shot(camera, Lens(), light=k) for k in range(2)]
    light = Light((0.0, 0.0, 1.0))
    sky = np.zeros((8, 8, 3), np.uint8)
    scene = DrawnScene([wall_and_screen(False), wall_and_screen(True)], [light] * 2, sky, shots, [(0, 1)])
    recent = scenes.dataset._Recent()
    recent.scene = lambda task: scene  # type: ignore[assignment]
    monkeypatch.setattr("fmtorch.scenes.dataset._recent", recent)
    return scenes.Task("indoor", "test", 0, 0, SMALL), camera


def test_what_moves_is_where_it_was_when_the_photograph_was_taken(staged: tuple[scenes.Task, scenes.Camera]) -> None:
    task, _ = staged
    points = np.array([[20.3, 30.1], [60.2, 30.7], [20.0, 1.0], [-0.6, 30.0], [30.0, 59.6], [np.nan, 1.0]])
    unknown = [np.nan] * 4  # the sky above the wall, left of the photograph, below it, no point
    np.testing.assert_allclose(scenes.depth_at(task, 0, points), [WALL, WALL, *unknown], rtol=1e-12)
    np.testing.assert_allclose(scenes.depth_at(task, 1, points)[:2], [SCREEN, WALL], rtol=1e-12)
    assert scenes.depth_at(task, 0, np.zeros((0, 2))).shape == (0,)


def test_depth_is_the_reference_ray_casters() -> None:
    """The plane that the nearest pixel meets, at the point itself; away from edges that is what the point meets."""
    task = scenes.Task("indoor", "test", 0, 0, SMALL)
    scene = scenes.dataset._recent.scene(task)
    shot = scene.shots[0]
    surfaces = scene.surfaces[shot.light]
    assert all(texture.opaque for texture in surfaces.textures)
    h, w = shot.camera.size
    points = np.random.default_rng(0).uniform(-0.5, [w - 0.5, h - 0.5], (12, 2))
    computed = scenes.depth_at(task, 0, points)
    direct = []
    for (x, y), depth in zip(points, computed, strict=True):
        pixel, _ = first_hit(surfaces, shot.camera, round(x), round(y))
        piece, depths = first_hit(surfaces, shot.camera, x, y)
        # float32 buffers decide between pieces that are equally near, as where two walls meet
        assert depth == pytest.approx(depths[pixel], rel=1e-6) or pixel != piece
        direct.append(depth == pytest.approx(depths[piece], rel=1e-4))
    assert np.mean(direct) > 0.8


def test_rendered_pairs_know_depth_by_image(tmp_path: Path) -> None:
    pairs = scenes.RenderedPairs(families=["indoor"], root=tmp_path, plan=SMALL, workers=1)
    assert isinstance(pairs, DepthDataset)
    assert not isinstance(load("stereo"), DepthDataset)
    pair = pairs[0]
    points = np.array([[10.2, 20.0], [40.0, 12.5]])
    task = scenes.Task("indoor", "test", 0, 0, SMALL)
    number = int(pair.image1.identity.rpartition("/")[2])
    np.testing.assert_array_equal(pairs.depth(pair.image1, points), scenes.depth_at(task, number, points))
    assert np.isfinite(pairs.depth(pair.image1, points)).all()
