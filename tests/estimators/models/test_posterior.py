"""Posteriors over cameras and lenses: cheirality, optima, tangents."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch.core import Correspondences
from fmtorch.estimators import BITS, Pair, SevenPoint, cheirality, lens_search
from fmtorch.estimators.lens_search import LensFit, LensPrior, fit_with_lenses
from fmtorch.estimators.models import posterior
from fmtorch.estimators.models.focal_prior import LOG_USUAL
from fmtorch.estimators.models.with_focals import FundamentalWithFocals
from fmtorch.estimators.refinement import PRIOR_CONFLICT_GAIN
from fmtorch.geometry.levenberg_marquardt import Schedule, Weighted
from tests.estimators.models.test_focals import TALL, WIDE, Sizes, photographs, with_prior
from tests.estimators.pairs import apart, in_pixels, pair_of, to_units
from tests.reference import focal as reference
from tests.reference import lenses
from tests.reference.refine import loss as loss_of
from tests.reference.solvers import sampson

FAMILY = FundamentalWithFocals()
SIZE = (480, 640)
Array = np.ndarray
LENSES = (-0.2, -0.1)
FREE = LensPrior(np.zeros(2), np.full(2, 1 / 0.15**2), False)


def near(F: np.ndarray, pair: Pair) -> posterior.Cameras:
    cameras = posterior.no_cameras(1)
    posterior.nearest_cameras(to_units(F, pair)[None], posterior.images_of(pair), cameras)
    return cameras


def evaluated(cameras: posterior.Cameras, pair: Pair, loss: str, px: float, precision: float) -> posterior.Optimum:
    """The posterior at cameras: `minimise` without a step; px: the loss's scale."""
    matches, out = posterior.centred(pair, px), posterior.start_at(cameras.copy())
    weighted = Weighted.of(matches.points, pair.weight, matches.s2, loss)
    posterior.minimise(out, weighted, posterior.images_of(pair), posterior.Limits(precision, 0, 0.0))
    return out


def moved(cameras: posterior.Cameras, by: np.ndarray) -> posterior.Cameras:
    """By three rotations of U, two of V, and two logarithms."""
    turned = cameras.copy()
    turned.axes[0, 0] = cameras.axes[0, 0] @ Rotation.from_rotvec(by[:3]).as_matrix()
    turned.axes[0, 1] = cameras.axes[0, 1] @ Rotation.from_rotvec([by[3], by[4], 0]).as_matrix()
    turned.focal[0] += by[5:]
    return turned


@pytest.mark.parametrize("sizes", [(WIDE, WIDE), (WIDE, TALL)])
@pytest.mark.parametrize("loss", ["truncated", "geman_mcclure"])
def test_cost_and_derivatives(loss: str, sizes: Sizes) -> None:
    c, truth, _ = photographs(0, sizes, outliers=0.1)
    noise = torch.from_numpy(np.random.default_rng(0).uniform(0.5, 2, (1, 200)))
    pair = pair_of(with_prior(c.replace(noise=noise)))
    cameras = moved(near(truth, pair), np.random.default_rng(1).normal(0, 3e-4, 7))
    precision, scale = 40.0 / 0.3**2 * pair.pixels_per_unit**2, 0.7
    computed = evaluated(cameras, pair, loss, scale, precision)
    x0, x1 = posterior.centred(pair).points[:2].T, posterior.centred(pair).points[2:].T
    s = scale * noise[0].numpy() / pair.pixels_per_unit

    def residuals(cameras: posterior.Cameras) -> np.ndarray:
        return sampson(evaluated(cameras, pair, loss, scale, precision).F.reshape(3, 3), x0, x1)

    def data(cameras: posterior.Cameras) -> float:
        r2 = residuals(cameras) ** 2
        each = [w * loss_of(np.array([r]), b * b, loss)[0] for w, r, b in zip(pair.weight, r2, s, strict=True)]
        return precision / 2 * sum(each)

    def prior(cameras: posterior.Cameras) -> float:
        return reference.prior_cost(*cameras.focal[0].tolist(), same_size=sizes[0] == sizes[1])

    assert computed.cost[0] == pytest.approx(data(cameras) + prior(cameras), rel=1e-9)
    # Differences of second order, of steps of 1e-6: relative 1e-8 or so by truncation, and by rounding of the cost.
    h, each = 1e-6, np.eye(7)
    ends = [(moved(cameras, -h * e), moved(cameras, h * e)) for e in each]
    gradient = [(data(b) + prior(b) - data(a) - prior(a)) / (2 * h) for a, b in ends]
    np.testing.assert_allclose(computed.gradient[0], gradient, rtol=1e-5, atol=1e-6 * np.abs(gradient).max())
    if loss == "truncated":  # the Hessian of Gauss and Newton, of matches that are not cut off
        J = np.stack([(residuals(b) - residuals(a)) / (2 * h) for a, b in ends], 1)
        weight = np.where(np.abs(residuals(cameras)) < s, pair.weight, 0)
        hessian = precision * (J * weight[:, None]).T @ J
        if sizes[0] != sizes[1]:  # the well of one camera is approximated
            k = 1e-3
            for i, j in ((5, 5), (5, 6), (6, 5), (6, 6)):
                signs = ((a, b) for a in (-1, 1) for b in (-1, 1))
                corners = (a * b * prior(moved(cameras, k * (a * each[i] + b * each[j]))) for a, b in signs)
                hessian[i, j] += sum(corners) / (4 * k * k)
            size = np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)))
            assert (np.abs(computed.hessian[0] - hessian) < 1e-6 * size).all()


def test_without_noise_a_model_stays_and_strange_focal_lengths_cost() -> None:
    c, truth, parameters = photographs(1, focal=(1.2, 1.2), noise=0.0, outliers=0.0)
    pair = pair_of(c)
    _, refined = FAMILY.refine(to_units(truth, pair)[None], pair, 12)
    # Residuals are below 1e-9 px here, so the prior's pull of a focal length of 1.2 is of the same order.
    assert apart(refined.models[0], to_units(truth, pair)) < 1e-6
    assert refined.cost[0] < 1e-12
    assert refined.share[0] == pytest.approx(1, abs=1e-5)
    strange = parameters + np.array([0, 0, 0, 0, 0, 0, np.log(3), -np.log(3)])
    _, refined = FAMILY.refine(to_units(reference.fundamental(strange, WIDE, TALL), pair)[None], pair, 0)
    assert refined.cost[0] == pytest.approx(reference.prior_cost(*strange[6:]), rel=1e-9)


@pytest.mark.parametrize("focal", [(1.1, 1.1), (1.1, 0.8), (0.45, 0.45)])
def test_the_fit_reaches_the_optimum_and_tells_what_the_prior_costs(focal: tuple[float, float]) -> None:
    noise, wide = 0.5, 50.0  # px
    c, truth, _ = photographs(5, (WIDE, WIDE), focal, 150, noise, outliers=0.0)
    pair = pair_of(c)
    precision = (pair.pixels_per_unit / noise) ** 2
    fitted, cameras, gain = FAMILY.fit(near(truth, pair), pair, wide, posterior.Limits(precision, 50, 0.0))
    end = evaluated(cameras, pair, "truncated", wide, precision)
    assert np.abs(end.gradient).max() < 1e-6 * np.abs(end.hessian).max()
    # What a fit without prior gains from there, in logarithms of the likelihood.
    x0, x1 = c.x0[0].numpy(), c.x1[0].numpy()
    (free,) = SevenPoint().refine(fitted[None], pair, "truncated", wide, Schedule(50, 1e-6, 0.0))
    costs = [(sampson(in_pixels(F, pair), x0, x1) ** 2).sum() / (2 * noise**2) for F in (fitted, free)]
    gained = costs[0] - costs[1]
    assert 0 < gained < PRIOR_CONFLICT_GAIN
    assert gain == pytest.approx(gained, rel=0.05)  # by a quadratic approximation


def test_a_fit_goes_on_after_a_rejected_step() -> None:
    """The first step from this start raises the cost; shorter ones gain more than what ends the fit."""
    c, truth, _ = photographs(2, (WIDE, WIDE), (1.0, 1.0), 150, 0.5, 0.3)
    pair, px = pair_of(c), 1.0
    precision, matches = (pair.pixels_per_unit / (px / 2)) ** 2, posterior.centred(pair_of(c), px)
    begin, _ = FAMILY.refine(to_units(truth, pair)[None], pair, 12)
    begin.focal[0] += [-0.15, 0.15]
    weighted = Weighted.of(matches.points, pair.weight, matches.s2)
    before, out = evaluated(begin, pair, "truncated", px, precision), posterior.start_at(begin.copy())
    posterior.minimise(out, weighted, posterior.images_of(pair), posterior.Limits(precision, 1, 0.05))
    assert out.cost == before.cost
    _, cameras, _ = FAMILY.fit(begin, pair, px, posterior.Limits(precision, 30, 0.05))
    after = evaluated(cameras, pair, "truncated", px, precision)
    assert after.cost < before.cost - 0.05


def test_models_that_are_not_finite_harm_no_other() -> None:
    c, truth, _ = photographs(4)
    pair = pair_of(c)
    good = to_units(truth, pair)[None]
    bad = np.concatenate([np.full_like(good, np.nan), np.zeros_like(good), good])
    _, alone = FAMILY.refine(good, pair, 12)
    _, among = FAMILY.refine(bad, pair, 12)
    for single, many in zip(alone, among, strict=True):
        np.testing.assert_array_equal(many[2], single[0])
    assert among.cost[:2].tolist() == [math.inf, math.inf]


def factors(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray, np.ndarray]:
    """A generator, E of random cameras, and factors of it with random signs and a random turn."""
    rng = np.random.default_rng(seed)
    t, R = rng.normal(size=3), Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
    E = np.cross(np.eye(3), -t / np.linalg.norm(t)) @ R
    U, _, Vt = np.linalg.svd(E)
    turn, angle = np.eye(3), rng.uniform(0, 2 * np.pi)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    U, V = U @ turn, Vt.T @ turn  # of a double singular value
    return rng, E, U * [1, 1, rng.choice([-1, 1])], V * [1, 1, rng.choice([-1, 1])]


def share(U: Array, V: Array, focal: Array, points: Array, support: Array, tolerance: float) -> float:
    K0, K1 = (np.diag([1 / f, 1 / f, 1]) for f in focal)
    F, out = (K1 @ U @ np.diag([1, 1, 0]) @ V.T @ K0).reshape(1, 9), np.empty(1)
    cameras = posterior.Cameras(np.stack([U, V])[None].copy(), np.log(focal)[None])
    matches = Weighted.of(points, support, np.full(len(support), 1e4), "geman_mcclure")
    cheirality(cameras, np.ones(2), F, matches, tolerance, out)
    return float(out[0])


@pytest.mark.parametrize("tolerance", [0.0, 0.02])
@pytest.mark.parametrize("seed", range(12))
def test_as_by_triangulation(seed: int, tolerance: float) -> None:
    rng, E, U, V = factors(seed)
    assert np.allclose(U @ np.diag([1, 1, 0]) @ V.T, E) or np.allclose(U @ np.diag([1, 1, 0]) @ V.T, -E)
    n, focal = 80, rng.uniform(0.8, 2, 2)
    x0 = rng.uniform(-0.8, 0.8, (n, 2))
    rays0 = np.c_[x0 / focal[0], np.ones(n)]
    # Points of image 1 on the epipolar lines, anywhere: about a quarter lie in front of each of the four camera pairs.
    lines = rays0 @ E.T
    x1 = rng.uniform(-0.8, 0.8, n)
    rays1 = np.c_[x1 / focal[1], -(lines[:, 0] * x1 / focal[1] + lines[:, 2]) / lines[:, 1], np.ones(n)]
    support = rng.integers(1, 1 << 10, n) / (1 << 10)  # of few bits: their sums are exact
    points = np.stack([*x0.T, *(rays1[:, :2] * focal[1]).T])
    computed = share(U, V, focal, points, support, tolerance)
    expected = reference.share_in_front(E, rays0, rays1, support, np.full(n, tolerance / focal[1]))
    # Supports are rounded to BITS, those of gains that rounding leaves a little below one.
    assert computed == pytest.approx(expected, abs=n * 2.0**-BITS / support.sum())
    assert 0.25 <= computed < 0.95  # neither all nor none, so that the comparison tells


def test_support_is_the_gain_of_geman_and_mcclure() -> None:
    """Matches off their lines count less, beyond five scales not at all: the rest is that of exact ones."""
    rng, E, U, V = factors(0)
    points = rng.uniform(-0.8, 0.8, (4, 60))
    weight, ones = rng.random(60), np.ones(2)
    h0, h1 = np.c_[points[:2].T, np.ones(60)], np.c_[points[2:].T, np.ones(60)]
    l1, l0 = h0 @ E.T, h1 @ E
    r2 = (h1 * l1).sum(1) ** 2 / (l1[:, :2] ** 2 + l0[:, :2] ** 2).sum(1)
    scale = 30.0
    gain = np.maximum(1 / (1 + r2 * scale) - 1 / 26, 0) / (1 - 1 / 26)
    cameras, out = posterior.Cameras(np.stack([U, V])[None].copy(), np.zeros((1, 2))), np.empty(1)
    loss, F = "geman_mcclure", (U @ np.diag([1, 1, 0]) @ V.T).reshape(1, 9)
    cheirality(cameras, ones, F, Weighted.of(points, weight, np.full(60, scale), loss), 0.0, out)
    computed = out[0]
    # The same, each match weighted by its gain, with a scale so small that all count fully.
    cheirality(cameras, ones, F, Weighted.of(points, weight * gain, np.full(60, 1e-12), loss), 0.0, out)
    assert computed == pytest.approx(out[0], abs=60 * 2.0**-BITS / (weight * gain).sum())


def models_of(cameras: posterior.Cameras, pair: Pair) -> np.ndarray:
    """Their fundamental matrices (k, 9), of a pair's points."""
    k, images = len(cameras.focal), posterior.images_of(pair)
    F, moved = np.empty((k, 9)), np.empty((k, 9))
    posterior.tangents_of(cameras, images.longest, F, np.zeros((k, 9, 8)))
    posterior.translate(F, images.offset, moved)
    return moved


@pytest.mark.parametrize("sizes", [(WIDE, WIDE), (WIDE, TALL)])
def test_cameras_of_a_model_are_those_that_made_it(sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    for seed in range(8):
        focal = tuple(np.random.default_rng(seed).uniform(0.6, 3, 2).tolist())
        c, truth, _ = photographs(seed, sizes, focal)
        pair = pair_of(c)
        cameras = near(truth, pair)
        # Bougnoux's formula loses the digits in which the axes' planes differ, 1e3 here at most, and its root half.
        np.testing.assert_allclose(np.exp(cameras.focal[0]), focal, rtol=1e-8)
        assert apart(models_of(cameras, pair)[0], to_units(truth, pair)) < 1e-9
        for axes in cameras.axes[0]:
            np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)


def test_implausible_focal_lengths_are_replaced_by_usual_ones() -> None:
    c, _, parameters = photographs(0)
    pair = pair_of(c)
    for first, second in ((0.2, 1.0), (1.0, 5.5), (0.1, 9.0)):
        strange = np.concatenate([parameters[:6], np.log([first, second])])
        cameras = near(reference.fundamental(strange, WIDE, TALL), pair)
        assert cameras.focal[0].tolist() == [LOG_USUAL, LOG_USUAL]
        for axes in cameras.axes[0]:
            np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)


def bent_pair() -> tuple[Pair, np.ndarray, np.ndarray]:
    """A pair, its matches (n, 4) in pixels, and F of pinholes."""
    x0, x1, F, _ = lenses.photographs(0, LENSES, SIZE, wrong=0)
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, len(x0), dtype=torch.bool),
        size0=torch.tensor([SIZE]), size1=torch.tensor([SIZE]),
    )  # fmt: skip
    return pair_of(c), np.c_[x0, x1], F


def test_residuals_are_those_of_the_photographs() -> None:
    pair, x, F = bent_pair()
    expected = [lenses.sampson(F, each, (SIZE, SIZE), LENSES) ** 2 for each in x]
    computed = lens_search.squared_px(to_units(F, pair), np.array(LENSES), pair)
    np.testing.assert_allclose(computed, expected, rtol=1e-5, atol=1e-9)


def test_noise_grows_as_the_lens_stretches() -> None:
    pair, x, _ = bent_pair()
    noise, step = lens_search.undistorted(pair, np.array(LENSES)).noises, 1e-3
    for k in range(0, len(x), 40):
        areas = []
        for i in range(2):
            at = x[k, 2 * i : 2 * i + 2]
            ends = ([lenses.straight(at + sign * d, SIZE, LENSES[i]) for sign in (-1, 1)] for d in step * np.eye(2))
            J = [(there - back) / 2 / step for back, there in ends]
            areas.append(abs(np.linalg.det(J)))
        assert noise[k] == pytest.approx(np.sqrt(np.mean(areas)), rel=1e-6)


def test_derivatives_are_those_of_the_cost() -> None:
    pair, _, F = bent_pair()
    cameras, lens, h = near(F, pair), np.array([-0.15, -0.13]), 1e-6

    def start(by: np.ndarray) -> LensFit:
        return fit_with_lenses(moved(cameras, by[:7]), (lens + by[7:])[None], FREE, pair, 2.0, 0)[0]

    gradient = start(np.zeros(9)).gradient
    for slope, step in zip(gradient, h * np.eye(9), strict=True):
        assert slope == pytest.approx((start(step).cost - start(-step).cost) / (2 * h), rel=1e-3, abs=1e-2)
