"""Recall, its curve and its mean: known answers, scalar references, properties."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fmtorch.metrics import mean_recall, recall, recall_curve
from tests.reference import metrics as reference

errors = st.lists(st.floats(0, 0.3) | st.just(1.0) | st.just(float("nan")), min_size=1, max_size=30)


def test_known_answers() -> None:
    nsgd = torch.tensor([0.0, 0.01, 0.05, 0.2, 1.0, torch.nan], dtype=torch.float64)
    assert recall(nsgd).item() == pytest.approx(2 / 6)  # 0.05 itself is a miss, and so is NaN
    assert recall(nsgd, 0.06).item() == pytest.approx(3 / 6)
    assert mean_recall(nsgd).item() == pytest.approx((1 + 0.8) / 6)
    curve = recall_curve(nsgd)
    assert curve.shape == (20,)
    assert curve[[0, 1, 5, 19]].tolist() == pytest.approx([0, 2 / 6, 3 / 6, 3 / 6])
    assert recall_curve(nsgd, torch.tensor([0.5], dtype=torch.float64)).tolist() == pytest.approx([4 / 6])


@given(errors)
def test_matches_scalar_reference(values: list[float]) -> None:
    nsgd = torch.tensor(values, dtype=torch.float64)
    for threshold in (0.01, 0.05, 0.2):
        assert recall(nsgd, threshold).item() == reference.recall(nsgd.numpy(), threshold)
        expected = reference.mean_recall(nsgd.numpy(), threshold)
        assert mean_recall(nsgd, threshold).item() == pytest.approx(expected, abs=1e-12)
    curve = recall_curve(nsgd).numpy()
    assert curve.tolist() == [reference.recall(nsgd.numpy(), t) for t in torch.linspace(0, 0.2, 20, dtype=nsgd.dtype)]
    assert (np.diff(curve) >= 0).all()


def test_mean_recall_is_differentiable() -> None:
    nsgd = torch.tensor([0.0, 0.02, 0.04, 0.3, torch.nan], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(mean_recall(nsgd), nsgd)
    assert gradient.tolist() == pytest.approx([-4.0, -4.0, -4.0, 0.0, 0.0])  # -1 / (0.05 * 5)
