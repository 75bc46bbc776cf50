"""The ray-caster and light draw the same pictures as their definitions in NumPy, to the last bit."""

from typing import Any

import numpy as np
import pytest

from fmtorch.scenes import FAMILIES, Camera, Plan, Task, build, calibration, look_at, raycast
from fmtorch.scenes.light import Lens, Light, Stage, expose
from fmtorch.scenes.raycast import Geometry
from fmtorch.scenes.surfaces import Surfaces, vec
from tests.reference import rendering as reference

SIZE = (90, 120)


def take_reference(patch: pytest.MonkeyPatch) -> None:
    """NumPy's forms in place of the kernels."""
    geometries = list[Geometry]()
    cast = Geometry.cast

    def remembered(self: Geometry, *arguments: Any) -> raycast.Hits:
        geometries.append(self)
        return cast(self, *arguments)

    patch.setattr(Geometry, "cast", remembered)
    patch.setattr(raycast, "cast_pieces", lambda pieces, _, *rest: reference.cast(geometries[-1], pieces, *rest))
    patch.setattr(Stage, "_shade", reference.shade)


def stages(surfaces: Surfaces, light: Light, sky: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> list[Stage]:
    built = [Stage(Geometry(surfaces), light, sky)]
    with monkeypatch.context() as patch:
        take_reference(patch)
        built.append(Stage(Geometry(surfaces), light, sky))
    np.testing.assert_array_equal(built[0].shadow, built[1].shadow)
    return built


def assert_equal_views(pair: list[Stage], camera: Camera, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Kernels and definitions meet the same pieces in the same places and draw the same picture; returns the pieces."""
    seen = [view(pair[0], camera)]
    with monkeypatch.context() as patch:
        take_reference(patch)
        seen.append(view(pair[1], camera))
    for compiled, expected in zip(*seen, strict=True):
        np.testing.assert_array_equal(compiled, expected)
    return seen[0][0]


def view(stage: Stage, camera: Camera) -> tuple[np.ndarray, ...]:
    """The pieces and places that the pixels see, their colours, and the photograph."""
    offset = (0.125, -0.375)
    hits = stage.geometry.look(camera, offset)
    picture = expose(stage, [camera], Lens(), np.random.default_rng(0))
    return hits.piece, hits.s, hits.t, stage.radiance(camera, offset), picture


@pytest.mark.parametrize("family", FAMILIES)
def test_forms_draw_the_same_scenes(family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = build(Task(family, "train", 1, 5, Plan(1, 3, 2, 0.15)))
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
        surfaces.piece(
            corner, U, V, numbers[k % 4], uv, triangle=bool(k % 2), normals=normals, both_sides=bool(rng.integers(2))
        )
    return surfaces


@pytest.mark.parametrize("seed", range(2))
def test_forms_draw_the_same_random_worlds(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    sky = rng.integers(0, 256, (16, 32, 3), dtype=np.uint8)
    light = Light((0.3, -0.5, 0.8), through_walls=bool(seed % 2))
    pair = stages(random_world(rng), light, sky, monkeypatch)
    for _ in range(3):
        eye, target = rng.normal(0, 3, (2, 3))
        assert_equal_views(pair, look_at(calibration(80.0, SIZE), SIZE, eye.tolist(), target.tolist()), monkeypatch)


def test_forms_draw_an_empty_view(monkeypatch: pytest.MonkeyPatch) -> None:
    surfaces = Surfaces()
    surfaces.quad(vec(0, 0, 0), vec(1, 0, 0), vec(0, 1, 0), surfaces.texture(np.zeros((8, 8, 3), np.uint8)))
    pair = stages(surfaces, Light((0.3, -0.5, 0.8)), np.full((8, 16, 3), 90, np.uint8), monkeypatch)
    camera = look_at(calibration(80.0, SIZE), SIZE, (0.0, 0.0, 5.0), (0.0, 1.0, 9.0))
    assert (assert_equal_views(pair, camera, monkeypatch) == -1).all()


def test_textures_too_small_to_shrink_are_refused() -> None:
    with pytest.raises(ValueError, match="4 x 9 pixels; each side must have at least 5"):
        Surfaces().texture(np.zeros((9, 4, 3), np.uint8))
