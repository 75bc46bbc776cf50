"""The posterior of two cameras with lenses: residuals, derivatives, and its maximum."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch.core.types import Correspondences
from fmtorch.estimators.lens_search import STRAIGHT, LensFit, fit_with_lenses, lens_prior, squared_px
from fmtorch.estimators.models.posterior import Cameras, images_of, nearest_cameras, no_cameras
from fmtorch.estimators.models.with_lenses import LensPrior, undistorted
from fmtorch.estimators.pair import Lens, Pair
from tests.estimators.pairs import pair_of
from tests.reference import lenses as reference

SIZE = (480, 640)
LENSES = (-0.2, -0.1)
FREE = LensPrior(np.zeros(2), np.full(2, 1 / 0.15**2), False)


def bent_pair(lenses: tuple[float, float] = LENSES) -> tuple[Pair, np.ndarray, np.ndarray]:
    """A pair, its matches (n, 4) in pixels, and F of pinholes."""
    x0, x1, F, _ = reference.photographs(0, lenses, SIZE, wrong=0)
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, len(x0), dtype=torch.bool),
        size0=torch.tensor([SIZE]), size1=torch.tensor([SIZE]),
    )  # fmt: skip
    return pair_of(c), np.c_[x0, x1], F


def in_units(F: np.ndarray, pair: Pair) -> np.ndarray:
    """A model of pixels as that (9,) of a pair's points."""
    T0, T1 = (
        np.array([[pair.pixels_per_unit, 0, x], [0, pair.pixels_per_unit, y], [0, 0, 1]])
        for x, y in pair.centre.reshape(2, 2)
    )
    G = T1.T @ F @ T0
    return (G / np.linalg.norm(G)).ravel()


def near(F: np.ndarray, pair: Pair) -> Cameras:
    cameras = no_cameras(1)
    nearest_cameras(in_units(F, pair)[None], images_of(pair), cameras)
    return cameras


def fitted(cameras: Cameras, lens: np.ndarray, pair: Pair, iterations: int, prior: LensPrior = FREE) -> LensFit:
    return fit_with_lenses(cameras, lens[None], prior, pair, 2.0, iterations)[0]


def test_residuals_are_those_of_the_photographs() -> None:
    pair, x, F = bent_pair()
    expected = [reference.sampson(F, each, (SIZE, SIZE), LENSES) ** 2 for each in x]
    np.testing.assert_allclose(squared_px(in_units(F, pair), np.array(LENSES), pair), expected, rtol=1e-5, atol=1e-9)


def test_undistorted_points_are_the_reference_s() -> None:
    pair, x, _ = bent_pair()
    points = undistorted(pair, np.array(LENSES)).points.T * pair.pixels_per_unit + pair.centre
    for i in range(2):
        expected = [reference.straight(each, SIZE, LENSES[i]) for each in x[:, 2 * i : 2 * i + 2]]
        np.testing.assert_allclose(points[:, 2 * i : 2 * i + 2], expected, atol=1e-9)


def test_noise_grows_as_the_lens_stretches() -> None:
    pair, x, _ = bent_pair()
    noise, step = undistorted(pair, np.array(LENSES)).noises, 1e-3
    for k in range(0, len(x), 40):
        areas = []
        for i in range(2):
            at = x[k, 2 * i : 2 * i + 2]
            J = [
                (reference.straight(at + d, SIZE, LENSES[i]) - reference.straight(at - d, SIZE, LENSES[i])) / 2 / step
                for d in step * np.eye(2)
            ]
            areas.append(abs(np.linalg.det(J)))
        assert noise[k] == pytest.approx(np.sqrt(np.mean(areas)), rel=1e-6)


def test_derivatives_are_those_of_the_cost() -> None:
    pair, _, F = bent_pair()
    cameras, lens, h = near(F, pair), np.array([-0.15, -0.13]), 1e-6

    def moved(i: int, by: float) -> float:
        axes, focal, own = cameras.axes.copy(), cameras.focal.copy(), lens.copy()
        if i < 5:
            axes[0, i // 3] = axes[0, i // 3] @ Rotation.from_rotvec(by * np.eye(3)[i % 3]).as_matrix()
        elif i < 7:
            focal[0, i - 5] += by
        else:
            own[i - 7] += by
        return fitted(Cameras(axes, focal), own, pair, 0).cost

    gradient = fitted(cameras, lens, pair, 0).gradient
    for i in range(9):
        assert gradient[i] == pytest.approx((moved(i, h) - moved(i, -h)) / (2 * h), rel=1e-3, abs=1e-2)


@pytest.mark.parametrize("start", [(0.0, 0.0), (-0.3, -0.3)])
def test_the_lenses_are_found_from_afar(start: tuple[float, float]) -> None:
    pair, _, F = bent_pair()
    wide = fit_with_lenses(near(F, pair), np.array([start]), FREE, pair, 20.0, 20)[0]
    fit = fitted(wide.cameras, wide.lens, pair, 20)
    assert fit.lens == pytest.approx(np.array(LENSES), abs=0.02)
    assert (np.abs(fit.lens - LENSES) < 5 * fit.deviation).all()
    assert abs(fit.F @ in_units(F, pair)) > 1 - 1e-3
    assert fit.cost < fitted(near(F, pair), np.array(LENSES), pair, 0).cost + 1
    assert np.abs(fitted(fit.cameras, fit.lens, pair, 0).gradient / np.sqrt(np.diag(fit.hessian))).max() < 0.2


def test_one_lens_and_straight_ones() -> None:
    pair, _, F = bent_pair((-0.15, -0.15))
    shared = lens_prior(Lens((0.0, 0.0), (np.inf, np.inf), True))
    fit = fitted(near(F, pair), np.array([-0.1, -0.1]), pair, 15, shared)
    assert fit.lens[0] == fit.lens[1] == pytest.approx(-0.15, abs=0.01)
    straight = fitted(near(F, pair), np.zeros(2), pair, 15, lens_prior(STRAIGHT))
    assert np.abs(straight.lens).max() < 1e-6
    assert fit.evidence > straight.evidence + 10
    known = fitted(near(F, pair), np.array([-0.15, -0.15]), pair, 15, lens_prior(Lens((-0.15,) * 2, (0.0,) * 2, True)))
    assert known.evidence > fit.evidence > fitted(near(F, pair), np.full(2, -0.15), pair, 15).evidence
