"""Robust losses, and iteratively reweighted fits by them."""

import hashlib

import numpy as np
import pytest
import torch
from scipy.special import gamma, gammainc
from torch import Tensor

from fmtorch.core import collate
from fmtorch.geometry import LOSSES, irls, reweighted_fits
from fmtorch.geometry.levenberg_marquardt import ENTRIES, GAIN_TABLE, LOSS_TABLE, QUANTILE, named_loss
from tests import laws
from tests.geometry.scenes import SCALE, distance, near_scene, tolerances, unit_scene
from tests.reference import solvers
from tests.reference.refine import loss as robust_loss

S2 = torch.tensor(4.0, dtype=torch.float64)
END = QUANTILE**2 / 2


def eight_point_once(F: np.ndarray, x0: np.ndarray, x1: np.ndarray, scale: float) -> np.ndarray:
    """One reweighted fit with the Cauchy loss, from the definition."""
    line1, line0 = np.c_[x0, np.ones(len(x0))] @ F.T, np.c_[x1, np.ones(len(x1))] @ F
    g2 = (line1[:, :2] ** 2).sum(1) + (line0[:, :2] ** 2).sum(1)
    return solvers.eight_point(x0, x1, scale**2 / (scale**2 + solvers.sampson(F, x0, x1) ** 2) / g2)


@pytest.mark.parametrize("seed", range(4))
def test_two_iterations_equal_the_definition(seed: int) -> None:
    expected, x0, x1 = unit_scene(seed, 120, 2e-3, 20)
    fitted = irls(*map(torch.from_numpy, (x0, x1, expected)), loss="cauchy", scale=0.01, iterations=2)
    for _ in range(2):
        expected = eight_point_once(expected, x0, x1, 0.01)
    # The sums of products square the condition of the equations (some 1e3): 1e-16 * 1e6, and a little room.
    assert distance(fitted.flatten(), torch.from_numpy(expected.flatten())) < 1e-9


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_are_those_of_the_fixed_point(loss: str) -> None:
    """Finite differences of the converged iteration."""
    x0, x1, F0, weight = near_scene(2, outliers=1)
    converged = irls(x0, x1, F0, weight, loss=loss, scale=SCALE, iterations=60)

    def function(x0: Tensor, x1: Tensor, w: Tensor) -> Tensor:
        return irls(x0, x1, converged, w, loss=loss, scale=SCALE, iterations=10)

    attached = [v.clone().requires_grad_() for v in (x0, x1, weight)]
    assert torch.autograd.gradcheck(function, attached, **tolerances(loss))


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_of_a_loss_make_it_irls(loss: str) -> None:
    """The same step serves both: `irls` is the iteration whose weights are w rho'(r^2) / g^2."""
    x0, x1, F0, weight = (torch.stack(v) for v in zip(*(near_scene(s) for s in range(3)), strict=True))
    F0 = F0 / F0.flatten(1).norm(dim=1)[:, None, None]
    robust = named_loss(loss)

    def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
        line1 = torch.einsum("bij,bnj->bni", F, torch.nn.functional.pad(x0, (0, 1), value=1.0))
        line0 = torch.einsum("bji,bnj->bni", F, torch.nn.functional.pad(x1, (0, 1), value=1.0))
        g2 = line1[..., :2].square().sum(-1) + line0[..., :2].square().sum(-1)
        return weight * robust.weight(residual.square(), torch.tensor(SCALE**2, dtype=torch.float64)) / g2

    fits = reweighted_fits(x0, x1, weigh, 3, F0=F0)
    assert bool(fits.valid.all())
    assert fits.F.shape == (3, 3, 3, 3)
    for i in range(3):
        expected = irls(x0, x1, F0, weight, loss=loss, scale=SCALE, iterations=i + 1)
        # Rounding of 1e-16 times the condition of the normal equations, 1e6.
        assert float(distance(fits.F[i].flatten(1).T, expected.flatten(1).T).max()) < 1e-9


def test_fits_of_hopeless_pairs() -> None:
    """Zero and not valid without a start, and that start with one; a fit that fails later repeats the last."""
    pairs = [laws.scene(1), *laws.degenerate().values()]
    c = collate([pair.replace(x0=pair.x0.double(), x1=pair.x1.double()) for pair in pairs])
    base = torch.where(c.mask, c.prior, 0).double().nan_to_num(0)
    weight = base.clone().requires_grad_()
    calls: list[int] = []

    def weigh(F: Tensor | None, residual: Tensor | None) -> Tensor:
        calls.append(0)
        weights = weight if residual is None else weight / (1 + residual.square())
        return weights if len(calls) < 3 else torch.where(torch.arange(len(c.mask))[:, None] == 0, -weights, weights)

    fits = reweighted_fits(c.x0, c.x1, weigh, 3, c.mask)
    assert fits.valid[:, 0].tolist() == [True, True, False]
    assert torch.equal(fits.F[2, 0], fits.F[1, 0])
    assert bool(fits.F.isfinite().all())
    never = ~fits.valid.any(0)
    assert bool(never.any())
    assert bool((fits.F[:, never] == 0).all())
    (gradient,) = torch.autograd.grad(fits.F.sum(), weight)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[never] == 0).all())
    start = torch.eye(3, dtype=torch.float64).expand(len(c.mask), 3, 3) / 3**0.5
    calls.clear()
    assert bool((reweighted_fits(c.x0, c.x1, weigh, 1, c.mask, F0=start).F[0, never] == start[0]).all())
    alone = reweighted_fits(pairs[0].x0.double(), pairs[0].x1.double(), lambda F, r: base[:1, :150], 1)
    assert torch.equal(alone.F[0, 0], fits.F[0, 0])


@pytest.mark.parametrize("name", LOSSES)
def test_weight_is_the_derivative_of_the_loss(name: str) -> None:
    r2 = torch.tensor([1e-3, 0.5, 3.9, 4.1, 7.0, 1e3], dtype=torch.float64)
    h = 1e-5 * r2
    rise = robust_loss((r2 + h).numpy(), 4.0, name) - robust_loss((r2 - h).numpy(), 4.0, name)
    slope = torch.from_numpy(rise) / (2 * h)
    # Central differences: relative error h^2 = 1e-10 by truncation, 1e-16 / 1e-5 = 1e-11 of the loss by rounding,
    # which at r^2 = 1000 is a few thousand times the slope times r^2.
    # The tabulated weight is linear between its 2,048 entries: off by 2.05e-5 in the first interval, 2.4e-6 beyond.
    assert torch.allclose(LOSSES[name].weight(r2, S2), slope, rtol=1e-7, atol=2.1e-5 if name == "magsac" else 1e-9)


@pytest.mark.parametrize("name", LOSSES)
def test_curvature_is_half_the_second_derivative_or_zero(name: str) -> None:
    # between the entries of the tabulated loss, where it is smooth
    r = torch.tensor([1e-3, 0.51, 1.01, 1.9, 2.1, 5.0, 30.0], dtype=torch.float64)
    h = 1e-5  # derivatives of the influence r rho', analytic above: errors h^2 by truncation, 1e-16 r / h by rounding
    influence = [(r + d) * LOSSES[name].weight((r + d).square(), S2) for d in (-h, h)]
    second = ((influence[1] - influence[0]) / (2 * h)).clamp_min(0)
    assert torch.allclose(LOSSES[name].curvature(r.square(), S2), second, rtol=1e-7, atol=1e-9)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="huber, cauchy, geman_mcclure, truncated, magsac"):
        named_loss("tukey")


def lower(s: float, x: np.ndarray | float) -> np.ndarray:
    return gammainc(s, x) * gamma(s)


def test_the_table_of_weights_and_losses() -> None:
    u = np.arange(ENTRIES + 1) / ENTRIES
    # Some forty roundings of numbers up to 1, here and in the reference.
    np.testing.assert_allclose(LOSS_TABLE[0, :-1], 1 - lower(1.5, u * END) / lower(1.5, END), rtol=0, atol=40 * 2**-53)
    assert (LOSS_TABLE[0, 0], LOSS_TABLE[0, -2], LOSS_TABLE[0, -1]) == (1, 0, 0)
    sums = np.concatenate([[0], np.cumsum((LOSS_TABLE[0, :-2] + LOSS_TABLE[0, 1:-1]) / 2)]) / ENTRIES
    np.testing.assert_allclose(LOSS_TABLE[1, :-1], sums, rtol=ENTRIES * 2**-53)


def test_the_table_of_gains() -> None:
    u = (np.arange(ENTRIES) + 0.5) / ENTRIES
    x = np.append(u, 1) * END
    loss = lower(2.5, x) / 2 + x / 2 * (lower(1.5, END) - lower(1.5, x))
    table = GAIN_TABLE
    np.testing.assert_allclose(table[:-1], 1 - loss[:-1] / loss[-1], rtol=0, atol=2**-24 + 40 * 2**-53)
    assert table[-1] == 0


def test_the_tables_have_the_same_bits_everywhere() -> None:
    digests = [hashlib.sha256(table.tobytes()).hexdigest()[:16] for table in (LOSS_TABLE, GAIN_TABLE)]
    assert digests == ["deeedca20dc708b5", "e7fdff710ef5cc3d"]


@pytest.mark.parametrize("loss", LOSSES)
def test_exact_matches_keep_the_exact_matrix(loss: str) -> None:
    F, x0, x1 = map(torch.from_numpy, unit_scene(5, 120))
    near = F + 1e-3 * torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3)))
    fitted = irls(x0, x1, near, loss=loss, scale=1.0)
    assert distance(fitted.flatten(), F.flatten()) < 1e-9  # as above
    assert float(torch.linalg.svdvals(fitted)[2]) < 1e-15
    assert float(fitted.norm()) == pytest.approx(1, abs=1e-15)
