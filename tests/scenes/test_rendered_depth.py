"""How far away the points of a rendered photograph are."""

from pathlib import Path

import numpy as np
import pytest

from fmtorch import scenes
from fmtorch.data import DepthDataset, load
from fmtorch.scenes import Camera, Plan, RenderedPairs, Task, build, calibration, depth_at, look_at
from fmtorch.scenes.light import DrawnScene, Lens, Light, Shot
from fmtorch.scenes.surfaces import Surfaces, vec
from tests.reference.labels import first_hit

SIZE = (60, 80)
WALL, SCREEN = 4.0, 2.5  # metres
SMALL = Plan(scenes=1, shots=2, pairs=1, scale=0.15)


def wall_and_screen(with_screen: bool) -> Surfaces:
    """A wall 3 m high in front of the origin, and a screen before its left half."""
    surfaces = Surfaces()
    grey = surfaces.texture(np.full((8, 8, 3), 128, np.uint8))
    surfaces.quad(vec(-9, WALL, 1.5), vec(18, 0, 0), vec(0, 0, -3), grey)
    if with_screen:
        surfaces.quad(vec(-9, SCREEN, 1.5), vec(9, 0, 0), vec(0, 0, -3), grey)
    return surfaces


@pytest.fixture
def staged(monkeypatch: pytest.MonkeyPatch) -> tuple[Task, Camera]:
    """A scene in which the screen stands only when the second photograph is taken."""
    camera = look_at(calibration(60.0, SIZE), SIZE, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    shots = [Shot(camera, Lens(), light=k) for k in range(2)]
    light = Light((0.0, 0.0, 1.0))
    sky = np.zeros((8, 8, 3), np.uint8)
    scene = DrawnScene([wall_and_screen(False), wall_and_screen(True)], [light] * 2, sky, shots, [(0, 1)])
    recent = scenes.dataset._Recent()
    recent.scene = lambda task: scene  # type: ignore[assignment]
    monkeypatch.setattr("fmtorch.scenes.dataset._recent", recent)
    return Task("indoor", "test", 0, 0, SMALL), camera


def test_what_moves_is_where_it_was_when_the_photograph_was_taken(staged: tuple[Task, Camera]) -> None:
    task, _ = staged
    points = np.array([[20.3, 30.1], [60.2, 30.7], [20.0, 1.0], [-0.6, 30.0], [30.0, 59.6], [np.nan, 1.0]])
    unknown = [np.nan] * 4  # the sky above the wall, left of the photograph, below it, no point
    np.testing.assert_allclose(depth_at(task, 0, points), [WALL, WALL, *unknown], rtol=1e-12)
    np.testing.assert_allclose(depth_at(task, 1, points)[:2], [SCREEN, WALL], rtol=1e-12)
    assert depth_at(task, 0, np.zeros((0, 2))).shape == (0,)


def test_depth_is_the_reference_ray_casters() -> None:
    """The plane that the nearest pixel meets, at the point itself; away from edges that is what the point meets."""
    task = Task("indoor", "test", 0, 0, SMALL)
    scene = build(task)
    shot = scene.shots[0]
    surfaces = scene.surfaces[shot.light]
    assert all(texture.opaque for texture in surfaces.textures)
    h, w = shot.camera.size
    points = np.random.default_rng(0).uniform(-0.5, [w - 0.5, h - 0.5], (25, 2))
    computed = depth_at(task, 0, points)
    direct = []
    for (x, y), depth in zip(points, computed, strict=True):
        pixel, _ = first_hit(surfaces, shot.camera, round(x), round(y))
        piece, depths = first_hit(surfaces, shot.camera, x, y)
        # float32 buffers decide between pieces that are equally near, as where two walls meet
        assert depth == pytest.approx(depths[pixel], rel=1e-6) or pixel != piece
        direct.append(depth == pytest.approx(depths[piece], rel=1e-4))
    assert np.mean(direct) > 0.8


def test_rendered_pairs_know_depth_by_image(tmp_path: Path) -> None:
    pairs = RenderedPairs(families=["indoor"], root=tmp_path, plan=SMALL, workers=1)
    assert isinstance(pairs, DepthDataset)
    assert not isinstance(load("stereo"), DepthDataset)
    pair = pairs[0]
    points = np.array([[10.2, 20.0], [40.0, 12.5]])
    task = Task("indoor", "test", 0, 0, SMALL)
    number = int(pair.image1.identity.rpartition("/")[2])
    np.testing.assert_array_equal(pairs.depth(pair.image1, points), depth_at(task, number, points))
    assert np.isfinite(pairs.depth(pair.image1, points)).all()
