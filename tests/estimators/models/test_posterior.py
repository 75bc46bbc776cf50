"""The posterior of two cameras: its derivatives, its maximum as SciPy finds it, and what the prior costs there."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch.estimators import Pair, SevenPoint
from fmtorch.estimators.final_fits import PRIOR_CONFLICT_GAIN
from fmtorch.estimators.models.model import Loss, Steps
from fmtorch.estimators.models.posterior import (
    Cameras,
    Limits,
    Optimum,
    centred,
    images_of,
    minimise,
    nearest_cameras,
    no_cameras,
    no_optimum,
)
from fmtorch.estimators.models.with_focals import LOSS_SCALE_PX, FundamentalWithFocals, Refined
from fmtorch.geometry.levenberg_marquardt import Weighted
from tests.estimators.models.photographs import TALL, WIDE, Sizes, photographs, with_prior
from tests.estimators.pairs import apart, in_pixels, pair_of, to_units
from tests.reference import focal as reference
from tests.reference.refine import loss as loss_of
from tests.reference.refine import sampson

FAMILY = FundamentalWithFocals()


def start(F: np.ndarray, pair: Pair) -> Cameras:
    """The cameras near one model (3, 3) of pixels."""
    cameras = no_cameras(1)
    nearest_cameras(to_units(F, pair)[None], images_of(pair), cameras)
    return cameras


def evaluated(cameras: Cameras, pair: Pair, loss: str, scale_px: float, precision: float) -> Optimum:
    """The posterior at cameras: `minimise` without a step."""
    matches, out = centred(pair, scale_px), no_optimum(1)
    weighted = Weighted.of(matches.points, pair.weight, matches.s2, loss)
    minimise(cameras.copy(), weighted, images_of(pair), Limits(precision, 0, 0.0), out)
    return out


def moved(cameras: Cameras, by: np.ndarray) -> Cameras:
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
    assert pair.prior is not None
    cameras = moved(start(truth, pair), np.random.default_rng(1).normal(0, 3e-4, 7))
    precision, scale = 40.0 / 0.3**2 * pair.pixels_per_unit**2, 0.7
    computed = evaluated(cameras, pair, loss, scale, precision)
    x0, x1 = centred(pair).points[:2].T, centred(pair).points[2:].T
    s = scale * noise[0].numpy() / pair.pixels_per_unit

    def residuals(cameras: Cameras) -> np.ndarray:
        return sampson(evaluated(cameras, pair, loss, scale, precision).F.reshape(3, 3), x0, x1)

    def data(cameras: Cameras) -> float:
        r2 = residuals(cameras) ** 2
        each = [w * loss_of(np.array([r]), b * b, loss)[0] for w, r, b in zip(pair.weight, r2, s, strict=True)]
        return precision / 2 * sum(each)

    def prior(cameras: Cameras) -> float:
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
                corners = [
                    a * b * prior(moved(cameras, k * (a * each[i] + b * each[j]))) for a in (-1, 1) for b in (-1, 1)
                ]
                hessian[i, j] += sum(corners) / (4 * k * k)
            size = np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)))
            assert (np.abs(computed.hessian[0] - hessian) < 1e-6 * size).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_cost_at_the_optimum_is_that_of_scipy(seed: int) -> None:
    c, truth, parameters = photographs(seed)
    c = with_prior(c)
    pair = pair_of(c)
    x0, x1, weight = c.x0[0].numpy(), c.x1[0].numpy(), c.prior[0].numpy()  # type: ignore[index]
    _, expected = reference.optimum(parameters, x0, x1, weight, LOSS_SCALE_PX, WIDE, TALL)
    # From the unconstrained optimum, as in the engine: focal lengths there are off, often implausible.
    F = SevenPoint().refine(to_units(truth, pair)[None], pair, Loss("truncated", LOSS_SCALE_PX), Steps(10, 1e-4))
    _, refined = FAMILY.refine(F, pair, 50)
    r = sampson(in_pixels(refined.models[0], pair), x0, x1)
    computed = (weight * reference.loss(r, LOSS_SCALE_PX)).sum() / (2 * 0.3**2) + refined.cost[0]
    # The loss has local minima, but on these pairs both end in the same one, where the cost is flat: an error of the
    # parameters enters squared, and SciPy stops within 1e-7 of the least cost.
    assert computed <= expected * (1 + 1e-9)
    assert computed == pytest.approx(expected, rel=1e-7)


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
    fit = FAMILY.fit(start(truth, pair), pair, wide, Limits(precision, 50, 0.0))
    end = evaluated(fit.cameras, pair, "truncated", wide, precision)
    assert np.abs(end.gradient).max() < 1e-6 * np.abs(end.hessian).max()
    # What a fit without prior gains from there, in logarithms of the likelihood.
    x0, x1 = c.x0[0].numpy(), c.x1[0].numpy()
    (free,) = SevenPoint().refine(fit.F[None], pair, Loss("truncated", wide), Steps(50, 1e-6))
    costs = [(sampson(in_pixels(F, pair), x0, x1) ** 2).sum() / (2 * noise**2) for F in (fit.F, free)]
    gained = costs[0] - costs[1]
    assert 0 < gained < PRIOR_CONFLICT_GAIN
    assert fit.gain == pytest.approx(gained, rel=0.05)  # by a quadratic approximation


def test_a_fit_goes_on_after_a_rejected_step() -> None:
    """The first step from this start raises the cost; shorter ones gain more than what ends the fit."""
    c, truth, _ = photographs(2, (WIDE, WIDE), (1.0, 1.0), 150, 0.5, 0.3)
    pair, px = pair_of(c), 1.0
    precision, matches = (pair.pixels_per_unit / (px / 2)) ** 2, centred(pair_of(c), px)
    begin, _ = FAMILY.refine(to_units(truth, pair)[None], pair, 12)
    begin.focal[0] += [0.1, -0.1]
    weighted = Weighted.of(matches.points, pair.weight, matches.s2)
    before = evaluated(begin, pair, "truncated", px, precision)
    single_step, out = begin.copy(), no_optimum(1)
    minimise(single_step, weighted, images_of(pair), Limits(precision, 1, 0.05), out)
    assert out.cost == before.cost
    fit = FAMILY.fit(begin, pair, px, Limits(precision, 30, 0.05))
    after = evaluated(fit.cameras, pair, "truncated", px, precision)
    assert after.cost < before.cost - 0.05


def test_models_that_are_not_finite_harm_no_other() -> None:
    c, truth, _ = photographs(4)
    pair = pair_of(c)
    good = to_units(truth, pair)[None]
    bad = np.concatenate([np.full_like(good, np.nan), np.zeros_like(good), good])
    _, alone = FAMILY.refine(good, pair, 12)
    _, among = FAMILY.refine(bad, pair, 12)
    assert isinstance(among, Refined)
    for single, many in zip(alone, among, strict=True):
        np.testing.assert_array_equal(many[2], single[0])
    assert among.cost[:2].tolist() == [math.inf, math.inf]
