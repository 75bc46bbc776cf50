"""Least-squares matching against its slow form, on images whose true map is known, and what it leaves alone."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core import Correspondences, GreyPyramid, ImagePruner
from fmtorch.core.stages import grey_pyramid
from fmtorch.pruning import refine_matches as compiled
from fmtorch.pruning.neighbors import neighbour_maps
from fmtorch.pruning.refine_matches import Pyramid
from tests.reference import refine_matches as reference

MAP = np.array([[1.1, -0.2], [0.15, 0.95]])
OFFSET = np.array([20.3, 40.6])


def texture(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """A smooth random function of points (..., 2), of wavelengths from 6 px on."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(60, 2)), rng.uniform(0, 2 * math.pi, 60)
    waves *= (2 * math.pi / rng.uniform(6, 40, 60) / np.linalg.norm(waves, axis=1))[:, None]
    return np.sin(points @ waves.T + phases).sum(-1) * 8 + 120


def images(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Two views (240, 320) of the texture, x1 = MAP x0 + OFFSET, the second darker, of less contrast and noisy."""
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), -1)
    rng = np.random.default_rng(1)
    before = (pixels - OFFSET) @ np.linalg.inv(MAP).T
    views = texture(pixels), 0.8 * texture(before) + 10 + rng.normal(0, noise, pixels.shape[:2])
    return views[0].clip(0, 255).round().astype(np.uint8), views[1].clip(0, 255).round().astype(np.uint8)


def levels(pyramid: GreyPyramid) -> list[np.ndarray]:
    return [pyramid.pixels[begin : begin + h * w].reshape(h, w) for h, w, begin in pyramid.levels]


def matches(count: int = 60, error: float = 0.5, scale: float = 12.0, seed: int = 0) -> Correspondences:
    """Matches of the two views with an error in image 1, and frames that know the map roughly."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform([40, 40], [180, 130], (count, 2))
    x1 = x0 @ MAP.T + OFFSET + rng.normal(0, error, (count, 2))
    A0 = np.broadcast_to(np.eye(2) * scale, (count, 2, 2))
    A1 = (MAP + rng.normal(0, 0.03, (count, 2, 2))) * scale
    tensor = lambda value: torch.from_numpy(np.asarray(value, np.float32))[None]  # noqa: E731
    return Correspondences(
        tensor(x0), tensor(x1), torch.ones(1, count, dtype=torch.bool),
        lafs0=tensor(np.concatenate([A0, x0[..., None]], 2)), lafs1=tensor(np.concatenate([A1, x1[..., None]], 2)),
    )  # fmt: skip


def error(c: Correspondences) -> np.ndarray:
    x0, x1 = (x[0].double().numpy() for x in (c.x0, c.x1))
    return np.linalg.norm(x1 - (x0 @ MAP.T + OFFSET), axis=1)


def stage(**options: Any) -> ImagePruner:
    return presets.build("pruner", "refine_matches", **options)


def pair(noise: float = 0.0) -> tuple[GreyPyramid, GreyPyramid]:
    first, second = images(noise)
    return grey_pyramid(first), grey_pyramid(second)


@pytest.mark.parametrize("spacing", [1.0, 1.6, 4.0, 7.0])
@pytest.mark.parametrize("radius", [3, 5])
def test_kernel_is_the_slow_form(spacing: float, radius: int) -> None:
    """Points of a whole range of errors, some of whose windows reach over the border."""
    first, second = pair(noise=2.0)
    c, n = matches(25, error=1.0), 25
    x0, x1 = c.x0[0].double().numpy(), c.x1[0].double().numpy()
    x0[:3] = [[2.0, 50.0], [319.0, 100.0], [100.0, 1.5]]
    affine = np.tile(MAP * 1.05, (n, 1, 1))
    windows = compiled.Windows(x0, x1, affine, np.full(n, spacing))
    out = compiled.Refined(np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 3)), np.empty(n), np.empty(n, bool))
    groups = Pyramid(*first), Pyramid(*second)
    compiled.refine_windows(windows, *groups, compiled.Fit(radius, 6, 0.8, 2.0, 1.0), out)
    refined = 0
    for i in range(n):
        slow = reference.refined(levels(first), levels(second), x0[i], x1[i], affine[i], spacing, radius, 6)
        expected = False
        if slow is not None:
            start, m = slow
            shift = np.linalg.norm(m.x1 - x1[i]) / (spacing * math.sqrt(np.linalg.det(affine[i])))
            exact = math.sqrt(np.linalg.eigvalsh(m.covariance)[-1]) <= 1.0
            expected = m.correlation >= max(start, 0.8) and shift <= 2.0 and exact
        assert bool(out.refined[i]) == expected
        refined += expected
        if expected:  # both in float64, by another order of sums and another factorization
            np.testing.assert_allclose(out.x1[i], m.x1, atol=1e-6)
            np.testing.assert_allclose(out.affine[i], m.affine, atol=1e-6)
            np.testing.assert_allclose(out.correlation[i], m.correlation, atol=1e-9)
            xx, xy, yy = out.covariance[i]
            np.testing.assert_allclose([[xx, xy], [xy, yy]], m.covariance, rtol=1e-5, atol=1e-9)
        else:
            np.testing.assert_array_equal(out.x1[i], x1[i])
    assert refined > 5 or spacing > 4


def test_errors_of_half_a_pixel_become_those_of_the_grey_levels() -> None:
    c = matches()
    refined = stage().with_images(c, lambda i: pair())
    assert np.median(error(c)) > 0.4
    moved = (refined.x1 != c.x1).any(-1)[0].numpy()
    assert moved.mean() > 0.9
    assert np.quantile(error(refined)[moved], 0.95) < 0.05
    A = refined.lafs1[0, :, :, :2].double().numpy() / 12
    assert np.abs(A[moved] - MAP).max() < 0.05
    assert bool((refined.lafs1[0, :, :, 2] == refined.x1[0])[torch.from_numpy(moved)].all())


def test_neighbours_stand_for_frames() -> None:
    """The maps of the slow form, and points as exact as with frames."""
    c = matches(80)
    wrong = torch.arange(80) % 4 == 0
    shuffled = c.replace(x1=torch.where(wrong[None, :, None], c.x1.flip(1), c.x1))
    for case in (c, shuffled, matches(3), matches(1)):
        x0, x1 = case.x0[0].double().numpy(), case.x1[0].double().numpy()
        maps = np.empty((len(x0), 2, 2))
        neighbour_maps(x0, x1, maps)
        for i, own in enumerate(maps):
            slow = reference.neighbour_map(x0, x1, i)
            np.testing.assert_allclose(own, np.full((2, 2), np.nan) if slow is None else slow, rtol=1e-9, atol=1e-12)
    refined = stage().with_images(shuffled.replace(lafs0=None, lafs1=None), lambda i: pair())
    assert refined.lafs1 is None
    moved = (refined.x1 != shuffled.x1).any(-1)[0].numpy()
    assert moved[~wrong.numpy()].mean() > 0.8
    assert np.quantile(error(refined)[moved], 0.95) < 0.05


def test_what_the_image_does_not_determine_stays() -> None:
    """At the border, without texture, along an edge, and where the windows show different things."""
    first, second = images()
    flat, edge = np.full_like(first, 90), np.where(np.arange(320) < 100, 50, 180).astype(np.uint8)[None].repeat(240, 0)
    c = matches(20)
    border = c.replace(x0=torch.full_like(c.x0, 3.0))
    on_edge = c.replace(x0=c.x0 * 0 + torch.tensor([100.0, 90.0]), x1=c.x0 * 0 + torch.tensor([100.4, 90.0]))
    same = torch.eye(2, 3) * 12
    on_edge = on_edge.replace(lafs0=same.expand(1, 20, 2, 3), lafs1=same.expand(1, 20, 2, 3))
    other = np.random.default_rng(0).integers(0, 255, first.shape).astype(np.uint8)
    for matches_, views in (
        (border, (first, second)), (c, (flat, flat)), (c, (first, flat)), (on_edge, (edge, edge)), (c, (first, other)),
    ):  # fmt: skip
        given = matches_.replace(noise=torch.rand(1, 20) + 0.5)
        refined = stage().with_images(given, lambda i, v=views: tuple(map(grey_pyramid, v)))
        for name in ("x1", "lafs1", "noise"):
            assert bool((getattr(refined, name) == getattr(given, name)).all()), name


def test_refuses_to_work_without_images_and_says_what_an_option_must_be() -> None:
    with pytest.raises(ValueError, match=r"refine_matches needs the images"):
        stage()(matches())
    with pytest.raises(ValueError, match=r"radius=0"):
        stage(radius=0)
