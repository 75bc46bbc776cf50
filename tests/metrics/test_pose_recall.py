"""Recall of pose errors: known answers, SuperGlue's area, OANet's histogram, the thresholds of the RANSAC tutorial."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fmtorch.metrics import pose_auc, pose_maa, pose_map
from tests.reference import metrics as reference

ERRORS = st.lists(
    st.floats(0, 40) | st.sampled_from([1.0, 5.0, 10.0, 15.0, 20.0]) | st.just(float("inf")), min_size=1, max_size=20
)


def test_auc_known_answers() -> None:
    errors = torch.tensor([2.0, 12.0], dtype=torch.float64)
    # To 5: a triangle of base 2 and height 1/2, then 3 at 1/2. To 20: up to 12 it rises from 1/2 to 1, then 8 at 1.
    expected = [(0.5 + 1.5) / 5, (0.5 + 4) / 10, (0.5 + 7.5 + 8) / 20]
    assert pose_auc(errors).tolist() == pytest.approx(expected)
    assert pose_auc(torch.tensor([torch.nan, torch.inf])).tolist() == [0, 0, 0]


@given(ERRORS)
def test_auc_as_superglue(values: list[float]) -> None:
    thresholds = (5, 10, 20)
    auc = pose_auc(torch.tensor(values, dtype=torch.float64), thresholds)
    assert auc.tolist() == pytest.approx(reference.pose_auc(values, thresholds), abs=1e-12)


def test_binned_known_answers() -> None:
    errors = torch.tensor([0.5, 5.0, 7.0, torch.nan], dtype=torch.float64)
    # Below 5: one of four; below 10, 15 and 20: three.
    assert pose_map(errors).tolist() == pytest.approx([1 / 4, (1 + 3) / 8, (1 + 3 + 3 + 3) / 16])
    # Up to 1, 2, 3, 4: one; up to 5 and 6: two; up to 7, 8, 9, 10: three.
    assert pose_maa(errors).item() == pytest.approx((4 * 1 + 2 * 2 + 4 * 3) / 40)
    assert pose_maa(torch.tensor([torch.nan, torch.inf])).item() == 0


@given(ERRORS)
def test_map_as_oanet_and_maa_as_the_ransac_tutorial(values: list[float]) -> None:
    errors = torch.tensor(values, dtype=torch.float64)
    assert pose_map(errors).tolist() == pytest.approx(reference.pose_map(values, (5, 10, 20)), abs=1e-12)
    assert pose_maa(errors).item() == pytest.approx(reference.pose_maa(values), abs=1e-12)


@given(ERRORS)
def test_wider_bins_never_give_less(values: list[float]) -> None:
    errors = torch.tensor(values, dtype=torch.float64)
    step = pose_map(errors, (20,), bin=0.01)[0]  # nearly the area under the step curve
    assert pose_map(errors, (20,))[0] >= step - 1e-12
    assert abs(step - torch.relu(1 - errors / 20).mean()) <= 0.01 / 20 + 1e-12


@pytest.mark.parametrize("thresholds", [(), (0,), (-5.0,), (7,), (5, 12.5)])
def test_thresholds_that_are_no_multiples_are_refused(thresholds: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="thresholds are"):
        pose_map(torch.zeros(3), thresholds)
    with pytest.raises(ValueError, match="maximum is 0"):
        pose_maa(torch.zeros(3), 0)
