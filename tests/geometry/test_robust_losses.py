from __future__ import annotations

import pytest
import torch

from fmtorch.geometry.robust_losses import LOSSES, named_loss

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


@pytest.mark.parametrize(
    ("name", "loss", "weight"),
    [("huber", 2 * 2 * 6 - 4, 1 / 3), ("cauchy", 4 * 2.302585092994046, 0.1), ("geman_mcclure", 3.6, 0.01),
     ("truncated", 4.0, 0.0)],
)  # fmt: skip
def test_known_values_at_three_scales(name: str, loss: float, weight: float) -> None:
    r2 = torch.tensor(36.0, dtype=torch.float64)
    assert LOSSES[name].loss(r2, S2).item() == pytest.approx(loss, rel=1e-14)
    assert LOSSES[name].weight(r2, S2).item() == pytest.approx(weight, rel=1e-14)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="huber, cauchy, geman_mcclure, truncated, magsac"):
        named_loss("tukey")
