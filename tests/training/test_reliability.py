"""Temperature and reliability: the least of the loss, known answers, the scalar reference, degenerate validation."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fmtorch.training.validation import MAX_TEMPERATURE, reliability, temperature
from tests.reference import pruner_losses as reference
from tests.training.test_pruner_losses import generator, labels


@settings(max_examples=20, deadline=None)
@given(true=st.floats(0.05, 20), seed=st.integers(0, 100))
def test_temperature_is_the_least_of_the_loss(true: float, seed: int) -> None:
    """No other temperature is better; logits scaled by s have s times the temperature; calibrated ones about 1."""
    z = 2 * torch.randn(20, 200, generator=generator(seed), dtype=torch.float64)
    label = (torch.rand(20, 200, generator=generator(seed + 1), dtype=torch.float64) < torch.sigmoid(z)).to(torch.int8)
    label[:, 150:] = -1
    found = temperature(z * true, label)
    assert found == pytest.approx(true * temperature(z, label), rel=1e-9)
    # 3,000 matches of logits of variance 4: Fisher information E[p (1 - p) z^2] is some 0.35 each.
    assert found / true == pytest.approx(1, abs=4.5 / math.sqrt(0.35 * 3000))

    def loss(t: float) -> float:
        kept = label >= 0
        cross_entropy = torch.nn.functional.binary_cross_entropy_with_logits
        return cross_entropy((z * true / t)[kept], label[kept].double()).item()

    assert loss(found) <= min(loss(found * 1.01), loss(found / 1.01))


def test_temperature_of_degenerate_validation() -> None:
    z = torch.tensor([2.0, -1.0, 0.5])
    one = torch.ones(3, dtype=torch.int8)
    assert temperature(z, -one) == 1
    assert temperature(z * 0, one) == 1
    assert temperature(z, (z > 0).to(torch.int8)) == pytest.approx(1 / MAX_TEMPERATURE)
    assert temperature(z, (z < 0).to(torch.int8)) == pytest.approx(MAX_TEMPERATURE)


def test_reliability() -> None:
    p = torch.rand(500, generator=generator(0), dtype=torch.float64)
    p[0], p[1] = 1.0, 0.0
    label = labels(1, 1, 500)[0]
    table = reliability(p, label, bins=7)
    kept = label >= 0
    expected = reference.expected_calibration_error(p[kept].tolist(), label[kept].tolist(), 7)
    assert table.error == pytest.approx(expected, rel=1e-12)
    assert int(table.matches.sum()) == int(kept.sum())
    exact = reliability(torch.tensor([0.25] * 4 + [0.875] * 8), torch.tensor([1, 0, 0, 0, 0] + [1] * 7).to(torch.int8))
    assert exact.error == 0
    assert exact.observed[[2, 8]].tolist() == [0.25, 0.875]
    assert bool(exact.predicted[[0, 1, 9]].isnan().all())
    assert math.isnan(reliability(p, torch.full_like(label, -1)).error)
    with pytest.raises(ValueError, match="bins is 0"):
        reliability(p, label, bins=0)
