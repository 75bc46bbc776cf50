import hashlib

import numpy as np
import pytest
import torch
from scipy.special import gamma, gammainc

from fmtorch.geometry import LOSSES
from fmtorch.geometry.robust_losses import ENTRIES, GAIN_TABLE, LOSS_TABLE, QUANTILE, named_loss

S2 = torch.tensor(4.0, dtype=torch.float64)


@pytest.mark.parametrize("name", LOSSES)
def test_weight_is_the_derivative_of_the_loss(name: str) -> None:
    r2 = torch.tensor([1e-3, 0.5, 3.9, 4.1, 7.0, 1e3], dtype=torch.float64)
    h = 1e-5 * r2
    slope = (LOSSES[name].loss(r2 + h, S2) - LOSSES[name].loss(r2 - h, S2)) / (2 * h)
    # Central differences: relative error h^2 = 1e-10 by truncation, 1e-16 / 1e-5 = 1e-11 of the loss by rounding,
    # which at r^2 = 1000 is a few thousand times the slope times r^2.
    assert torch.allclose(LOSSES[name].weight(r2, S2), slope, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", LOSSES)
def test_curvature_is_half_the_second_derivative_or_zero(name: str) -> None:
    # between the entries of the tabulated loss, where it is smooth
    r = torch.tensor([1e-3, 0.51, 1.01, 1.9, 2.1, 5.0, 30.0], dtype=torch.float64)
    h = 1e-5  # derivatives of the influence r rho', analytic above: errors h^2 by truncation, 1e-16 r / h by rounding
    influence = [(r + d) * LOSSES[name].weight((r + d).square(), S2) for d in (-h, h)]
    second = ((influence[1] - influence[0]) / (2 * h)).clamp_min(0)
    assert torch.allclose(LOSSES[name].curvature(r.square(), S2), second, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", LOSSES)
def test_quadratic_near_zero_and_never_above(name: str) -> None:
    zero = torch.zeros((), dtype=torch.float64)
    assert LOSSES[name].loss(zero, S2) == 0
    assert LOSSES[name].weight(zero, S2) == 1
    r2 = torch.logspace(-6, 6, 50, dtype=torch.float64)
    loss, weight = LOSSES[name].loss(r2, S2), LOSSES[name].weight(r2, S2)
    assert bool((loss <= r2 * (1 + 1e-15)).all())
    assert bool((loss.diff() >= 0).all())
    assert bool(((weight >= 0) & (weight <= 1)).all())
    assert bool((weight.diff() <= 0).all())


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="huber, cauchy, geman_mcclure, truncated, magsac"):
        named_loss("tukey")


END = QUANTILE**2 / 2


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
    assert digest(LOSS_TABLE) == "deeedca20dc708b5"
    assert digest(GAIN_TABLE) == "e7fdff710ef5cc3d"


def digest(table: np.ndarray) -> str:
    return hashlib.sha256(table.tobytes()).hexdigest()[:16]
