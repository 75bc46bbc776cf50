"""Pose errors: known answers, SuperGlue's evaluation, OpenCV's decomposition, gradients, laws."""

import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.geometry import cross_matrix
from fmtorch.metrics import closest_pose_error, fundamental_pose_error, pose_error
from tests.geometry.scenes import scene
from tests.reference import metrics as reference
from tests.reference import solvers


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


def test_bad_poses_are_the_worst() -> None:
    R, t, R_gt, t_gt = poses(1, 6)
    R[1], t[2], t[3], t_gt[4] = torch.nan, torch.inf, 0.0, 0.0
    error = pose_error(R, t, R_gt, t_gt)
    assert error.rotation[[1, 2]].tolist() == [180, 180]
    assert error.translation[[1, 2, 3, 4]].tolist() == [90, 90, 90, 0]
    assert pose_error(R, t, R_gt, t_gt, up_to_sign=False).translation[3].item() == 180


def test_gradients() -> None:
    inputs = [v.requires_grad_() for v in poses(2, 3)]
    assert torch.autograd.gradcheck(lambda *p: pose_error(*p).worst, inputs)
    R, t = (v.detach().requires_grad_() for v in inputs[:2])
    exact = pose_error(R, t, R.detach(), t.detach())
    assert exact.worst.detach().max() == 0
    for value in torch.autograd.grad(exact.rotation.sum() + exact.translation.sum(), [R, t]):
        assert value.isfinite().all()


def perturbed(count: int) -> list[Tensor]:
    """F of noisy matches by the eight-point algorithm, K0, K1, the matches, and the true motion: (count, ...)."""
    scenes = [scene(20, seed, noise=1.0) for seed in range(count)]
    F = [torch.from_numpy(cv2.findFundamentalMat(s.x0.numpy(), s.x1.numpy(), cv2.FM_8POINT)[0]) for s in scenes]
    columns = zip(*((f, s.K0, s.K1, s.x0, s.x1, s.R, s.t) for f, s in zip(F, scenes, strict=True)), strict=True)
    return [torch.stack(list(column)) for column in columns]


def test_of_a_fundamental_matrix_as_brute_force_and_opencv() -> None:
    inputs = perturbed(10)
    error = fundamental_pose_error(*inputs)
    for i, (F, K0, K1, x0, x1, R_gt, t_gt) in enumerate(zip(*(a.numpy() for a in inputs), strict=True)):
        R, t, _ = solvers.pose(F, K0, K1, x0, x1)
        rays = [solvers.homogeneous(x) @ np.linalg.inv(K).T for x, K in ((x0, K0), (x1, K1))]
        _, R_cv, t_cv, _ = cv2.recoverPose(K1.T @ F @ K0, rays[0][:, :2], rays[1][:, :2], np.eye(3))
        for rotation, direction in ((R, t), (R_cv, t_cv[:, 0])):
            # arccos at a cosine near 1: its rounding of 1e-16 is an angle of 1e-16 / sin(angle)
            expected = reference.rotation_angle(rotation, R_gt), reference.direction_angle(direction, t_gt)
            assert (error.rotation[i].item(), error.translation[i].item()) == pytest.approx(expected, abs=1e-7)


def test_the_right_fundamental_matrix_has_no_error_at_any_scale_and_sign() -> None:
    s = scene(20, 3)
    for factor in (1.0, -1.0, 1e-6, 1e6):
        error = fundamental_pose_error(factor * s.F, s.K0, s.K1, s.x0, s.x1, s.R, 7 * s.t)
        assert error.worst.item() < 1e-8
    signed = fundamental_pose_error(s.F, s.K0, s.K1, s.x0, s.x1, s.R, -s.t, up_to_sign=False)
    assert signed.translation.item() == pytest.approx(180, abs=1e-5)


def test_gradient_of_a_fundamental_matrix() -> None:
    F, K0, K1, x0, x1, R, t = (a[0] for a in perturbed(1))
    pixels = torch.diag(torch.tensor([500.0, 500, 1], dtype=torch.float64))  # of unit size, for finite differences
    F, K0, K1 = pixels @ F @ pixels, pixels.inverse() @ K0, pixels.inverse() @ K1
    leaves = [a.requires_grad_() for a in (F / F.norm(), K0, K1)]

    def angles(F: Tensor, K0: Tensor, K1: Tensor) -> tuple[Tensor, Tensor]:
        return tuple(fundamental_pose_error(F, K0, K1, x0 / 500, x1 / 500, R, t))

    assert torch.autograd.gradcheck(angles, leaves)


def test_the_closest_pose_of_a_fundamental_matrix_is_the_reference() -> None:
    """Of random matrices, and of nearly right ones, whose best pose is the true one."""
    g = torch.Generator().manual_seed(4)
    F, K0, K1, _, _, R_gt, t_gt = perturbed(10)
    F = torch.cat([F, torch.randn(30, 3, 3, generator=g, dtype=torch.float64)])
    K0, K1, R_gt, t_gt = (torch.cat([v, v, v, v]) for v in (K0, K1, R_gt, t_gt))
    K0[10:], K1[10:] = torch.eye(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    error = closest_pose_error(F, K0, K1, R_gt, t_gt)
    for i in range(len(F)):
        four = solvers.poses((K1[i].T @ F[i] @ K0[i]).numpy())
        expected = reference.closest_pose_error(four, R_gt[i].numpy(), t_gt[i].numpy())
        assert (error.rotation[i].item(), error.translation[i].item()) == pytest.approx(expected, abs=1e-6)
    assert float(error.worst[:10].max()) < 20
    assert float(error.worst[10:].max()) > 90


def test_without_a_matrix_or_a_match_before_the_cameras_the_error_is_the_worst() -> None:
    inputs = perturbed(3)
    F, K0, K1, *_, R, t = inputs
    inputs[0][1] = torch.nan
    mask = torch.ones(3, 20, dtype=torch.bool)
    mask[2] = False
    error, closest = fundamental_pose_error(*inputs, mask), closest_pose_error(F, K0, K1, R, t)
    assert error.rotation[1:].tolist() == [180, 180]
    assert error.translation[1:].tolist() == [90, 90]
    assert float(error.worst[0]) < 90
    assert closest.rotation[1].item() == closest.translation[1].item() == 180
