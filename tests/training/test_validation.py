"""Validation of pruners: figures of known networks; temperature and reliability against the scalar reference."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from fmtorch import presets
from fmtorch.core import Correspondences
from fmtorch.pruning import LC
from fmtorch.training import Use, Validation, reliability, temperature
from tests.reference import pruner_losses as reference
from tests.training.conftest import labelled_pair
from tests.training.test_objective import generator, labels


class Known(nn.Module):
    """Gives back log-odds that are known for each pair by its key."""

    def __init__(self, logit: dict[int, torch.Tensor]) -> None:
        super().__init__()
        self.logit = logit

    def forward(self, c: Correspondences) -> torch.Tensor:
        return self.logit[int(c.keys[0])]


def test_validation_tells_a_network_that_knows_from_one_that_does_not() -> None:
    pairs = [labelled_pair(i, outliers=0.7) for i in range(5)]
    uses = {"hard": Use(presets.build("estimator", "irls", loss="huber"), 0.5)}
    validation = Validation(pairs, uses, ["a", "a", "b", "b", "b"])
    right = {int(pair.correspondences.keys[0]): 8.0 * (2 * pair.label.float() - 1) for pair in pairs}
    wrong = {i: torch.full_like(value, 0.1) for i, value in right.items()}
    knows, not_ = (validation(Known(value)) for value in (right, wrong))
    assert knows.figures["hard/AUC@0.05"] > 0.9
    assert knows.figures["hard/AUC@0.05"] > not_.figures["hard/AUC@0.05"]
    assert knows.figures["match_precision"] == knows.figures["match_recall"] == 1.0
    assert not_.figures["match_recall"] == 1.0
    share = sum(float((pair.label == 1).sum()) for pair in pairs) / sum(pair.label.numel() for pair in pairs)
    assert not_.figures["match_precision"] == pytest.approx(share)
    assert {"hard/AUC@0.05/a", "hard/AUC@0.05/b", "log_loss", "calibration_error"} <= set(knows.figures)
    assert knows.figures["log_loss"] == pytest.approx(float(torch.nn.functional.softplus(torch.tensor(-8.0))), rel=1e-3)
    assert len(knows.label) == sum(pair.label.numel() for pair in pairs)


def test_validation_leaves_the_network_in_its_mode() -> None:
    network = LC(channels=8, blocks=1).train()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    Validation([labelled_pair(0)], {})(network)
    assert network.training
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    with pytest.raises(ValueError, match="at least one pair"):
        Validation([], {})


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
    right, wrong = (temperature(z, label.to(torch.int8)) for label in (z > 0, z < 0))  # the bounds
    assert right < 0.1
    assert right * wrong == pytest.approx(1)


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
