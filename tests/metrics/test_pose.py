"""Pose errors and their area under the curve: known answers, SuperGlue's evaluation, gradients, laws."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fmtorch.geometry import cross_matrix
from fmtorch.metrics import pose_auc, pose_error
from tests.reference import metrics as reference


def rotation(axis_angle: Tensor) -> Tensor:
    return torch.linalg.matrix_exp(cross_matrix(axis_angle))


def poses(seed: int, *batch: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    a, b, t, s = (torch.randn(*batch, 3, generator=g, dtype=torch.float64) for _ in range(4))
    return rotation(a), t, rotation(b), s


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 1.0, 60.0, 90.0, 179.0, 180.0])
def test_known_angles(degrees: float) -> None:
    angle = math.radians(degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    R = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    t = torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64)
    turned = R @ t * 0.3
    error = pose_error(R, turned, torch.eye(3, dtype=torch.float64), t)
    # Squared cosines are exact to 1e-16: an angle to 1e-16 / cos(angle / 2) rad, to the root of 1e-16 at 180 degrees.
    tolerance = 1e-11 if degrees < 179.5 else 1e-5
    assert error.rotation.item() == pytest.approx(degrees, abs=tolerance)
    assert error.translation.item() == pytest.approx(min(degrees, 180 - degrees), abs=1e-11)
    assert error.worst.item() == max(error.rotation.item(), error.translation.item())
    signed = pose_error(R, turned, torch.eye(3, dtype=torch.float64), t, up_to_sign=False)
    assert signed.translation.item() == pytest.approx(degrees, abs=tolerance)


def test_matches_scalar_reference() -> None:
    R, t, R_gt, t_gt = poses(0, 4, 5)
    error = pose_error(R, t, R_gt, t_gt)
    for i in range(4):
        for j in range(5):
            r = reference.rotation_angle(R[i, j].numpy(), R_gt[i, j].numpy())
            d = reference.direction_angle(t[i, j].numpy(), t_gt[i, j].numpy())
            assert (error.rotation[i, j].item(), error.translation[i, j].item()) == pytest.approx((r, d), rel=1e-9)


def test_bad_poses_are_the_worst_and_leave_neighbours_alone() -> None:
    R, t, R_gt, t_gt = poses(1, 6)
    good = pose_error(R, t, R_gt, t_gt)
    R[1], t[2], t[3], t_gt[4] = torch.nan, torch.inf, 0.0, 0.0
    error = pose_error(R.requires_grad_(), t.requires_grad_(), R_gt, t_gt)
    assert error.rotation[[1, 2]].tolist() == [180, 180]
    assert error.translation[[1, 2, 3, 4]].tolist() == [90, 90, 90, 0]
    assert pose_error(R, t, R_gt, t_gt, up_to_sign=False).translation[3].item() == 180
    for value in (*torch.autograd.grad(error.worst.sum(), [R, t]),):
        assert value.isfinite().all()
    for i in range(6):
        alone = pose_error(R[i], t[i], R_gt[i], t_gt[i])
        assert torch.equal(alone.rotation, error.rotation[i])
        assert torch.equal(alone.translation, error.translation[i])
    assert torch.equal(good.rotation[[0, 5]], error.rotation[[0, 5]])


def test_gradients() -> None:
    inputs = [v.requires_grad_() for v in poses(2, 3)]
    assert torch.autograd.gradcheck(lambda *p: pose_error(*p).worst, inputs)
    R, t = (v.detach().requires_grad_() for v in inputs[:2])
    exact = pose_error(R, t, R.detach(), t.detach())
    assert exact.worst.detach().max() == 0
    for value in torch.autograd.grad(exact.rotation.sum() + exact.translation.sum(), [R, t]):
        assert value.isfinite().all()


def test_auc_known_answers() -> None:
    errors = torch.tensor([2.0, 12.0], dtype=torch.float64)
    # To 5: a triangle of base 2 and height 1/2, then 3 at 1/2. To 20: up to 12 it rises from 1/2 to 1, then 8 at 1.
    expected = [(0.5 + 1.5) / 5, (0.5 + 4) / 10, (0.5 + 7.5 + 8) / 20]
    assert pose_auc(errors).tolist() == pytest.approx(expected)
    assert pose_auc(torch.tensor([torch.nan, torch.inf])).tolist() == [0, 0, 0]


@given(st.lists(st.floats(0, 40) | st.just(5.0) | st.just(float("inf")), min_size=1, max_size=20))
def test_auc_as_superglue(values: list[float]) -> None:
    thresholds = (5, 10, 20)
    auc = pose_auc(torch.tensor(values, dtype=torch.float64), thresholds)
    assert auc.tolist() == pytest.approx(reference.pose_auc(values, thresholds), abs=1e-12)


def test_auc_batches() -> None:
    errors = torch.rand(2, 3, 40, dtype=torch.float64) * 30
    auc = pose_auc(errors)
    assert auc.shape == (2, 3, 3)
    torch.testing.assert_close(auc[1, 2], pose_auc(errors[1, 2]), rtol=1e-13, atol=0)
    assert torch.autograd.gradcheck(pose_auc, errors[0].requires_grad_())
