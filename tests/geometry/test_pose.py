from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import motion_from_essential_choose_solution

from fmtorch.geometry import pose_from_fundamental
from tests.geometry.scenes import scene
from tests.reference import solvers as reference


def stack(batch, n=20, noise=0.0):
    many = [scene(n, i, noise) for i in range(int(np.prod(batch, dtype=int)))]
    columns = (torch.stack(list(a)) for a in zip(*many, strict=True))
    return [a.reshape(*batch, *a.shape[1:]) for a in columns]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_exact_pose(batch, dtype):
    x0, x1, F, K0, K1, R, t = stack(batch)
    sign = torch.where(torch.rand(*batch, 1, 1) < 0.5, 1, -1)
    pose = pose_from_fundamental(*(a.to(dtype) for a in (sign * F, K0, K1, x0, x1)))
    # F in pixels has entries from 1e-6 to 1: rounding it moves E by eps times 1000, the focal length.
    tolerance = 1e4 * torch.finfo(dtype).eps
    torch.testing.assert_close(pose.R, R.to(dtype), rtol=0, atol=tolerance)
    torch.testing.assert_close(pose.t, t.to(dtype), rtol=0, atol=tolerance)
    assert pose.valid.all()
    assert (pose.n_in_front == 20).all()


def test_brute_force_opencv_and_kornia():
    for seed in range(10):
        s = scene(40, seed, noise=1.0)
        # a perturbed F of rank two: singular values of E no longer equal
        F = torch.from_numpy(cv2.findFundamentalMat(s.x0.numpy(), s.x1.numpy(), cv2.FM_8POINT)[0])
        pose = pose_from_fundamental(F, s.K0, s.K1, s.x0, s.x1)
        R, t, count = reference.pose(*(a.numpy() for a in (F, s.K0, s.K1, s.x0, s.x1)))
        np.testing.assert_allclose(pose.R, R, atol=1e-10)
        np.testing.assert_allclose(pose.t, t, atol=1e-10)
        assert pose.n_in_front == count
        E = (s.K1.T @ F @ s.K0)[None]
        R_k, t_k = motion_from_essential_choose_solution(E, s.K0[None], s.K1[None], s.x0[None], s.x1[None])[:2]
        torch.testing.assert_close(pose.R, R_k[0], rtol=0, atol=1e-10)
        torch.testing.assert_close(pose.t, t_k[0, :, 0], rtol=0, atol=1e-10)
        rays = [reference.homogeneous(x.numpy()) @ np.linalg.inv(K.numpy()).T for x, K in ((s.x0, s.K0), (s.x1, s.K1))]
        _, R_cv, t_cv, _ = cv2.recoverPose(E[0].numpy(), rays[0][:, :2], rays[1][:, :2], np.eye(3))
        np.testing.assert_allclose(pose.R, R_cv, atol=1e-10)
        np.testing.assert_allclose(pose.t, t_cv[:, 0], atol=1e-10)
        np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-14)


def test_masked_points_and_neighbours_do_not_count():
    x0, x1, F, K0, K1, _, _ = stack((5,), noise=1.0)
    mask = torch.arange(20).expand(5, 20) < 15
    pose = pose_from_fundamental(F, K0, K1, x0, x1, mask)
    assert (pose.n_in_front <= 15).all()
    bad = [torch.where(mask[..., None], x, torch.nan) for x in (x0, x1)]
    for a, b in zip(pose, pose_from_fundamental(F, K0, K1, *bad, mask), strict=True):
        assert torch.equal(a, b)
    for i in range(5):
        alone = pose_from_fundamental(F[i], K0[i], K1[i], x0[i, :15], x1[i, :15])
        assert all(torch.equal(a, b[i]) for a, b in zip(alone, pose, strict=True))


def test_bad_input_is_invalid_and_alone():
    x0, x1, F, K0, K1, R, _ = stack((7,))
    F[0] = 0
    F[1, 0, 0] = torch.nan
    K0[2] = 0
    K1[3, 0, 0] = torch.inf
    F[4] = torch.outer(F[4, 0], F[4, 1])  # rank one
    mask = torch.ones(7, 20, dtype=torch.bool)
    mask[5] = False
    for leaf in (F, K0, K1):
        leaf.requires_grad_()
    pose = pose_from_fundamental(F, K0, K1, x0, x1, mask)
    assert pose.valid.tolist() == [False] * 6 + [True]
    assert torch.equal(pose.R[:6].detach(), torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    assert not pose.t[:6].any()
    torch.testing.assert_close(pose.R[6], R[6])
    (pose.R.sum() + pose.t.sum()).backward()
    for leaf in (F, K0, K1):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()


def test_gradient():
    s = scene(20, 1, noise=1.0)
    pixels = torch.diag(torch.tensor([500.0, 500, 1], dtype=torch.float64))
    F = pixels @ s.F @ pixels
    scale = torch.tensor([500.0, 500.0], dtype=torch.float64)
    K0, K1 = (torch.diag(torch.tensor([1 / 500, 1 / 500, 1.0], dtype=torch.float64)) @ K for K in (s.K0, s.K1))
    F = (F / F.norm()).requires_grad_()

    def pose(F, K0, K1):
        return pose_from_fundamental(F, K0, K1, s.x0 / scale, s.x1 / scale)[:2]

    assert torch.autograd.gradcheck(pose, (F, K0.requires_grad_(), K1.requires_grad_()))
