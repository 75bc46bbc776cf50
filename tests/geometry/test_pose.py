import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import motion_from_essential_choose_solution

from fmtorch.geometry import pose_from_fundamental
from fmtorch.geometry.pose import pose
from tests.geometry.scenes import scene
from tests.reference import known_cameras, solvers


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
        R, t, count = solvers.pose(*(a.numpy() for a in (F, s.K0, s.K1, s.x0, s.x1)))
        np.testing.assert_allclose(pose.R, R, atol=1e-10)
        np.testing.assert_allclose(pose.t, t, atol=1e-10)
        assert pose.n_in_front == count
        E = (s.K1.T @ F @ s.K0)[None]
        R_k, t_k = motion_from_essential_choose_solution(E, s.K0[None], s.K1[None], s.x0[None], s.x1[None])[:2]
        torch.testing.assert_close(pose.R, R_k[0], rtol=0, atol=1e-10)
        torch.testing.assert_close(pose.t, t_k[0, :, 0], rtol=0, atol=1e-10)
        rays = [solvers.homogeneous(x.numpy()) @ np.linalg.inv(K.numpy()).T for x, K in ((s.x0, s.K0), (s.x1, s.K1))]
        _, R_cv, t_cv, _ = cv2.recoverPose(E[0].numpy(), rays[0][:, :2], rays[1][:, :2], np.eye(3))
        np.testing.assert_allclose(pose.R, R_cv, atol=1e-10)
        np.testing.assert_allclose(pose.t, t_cv[:, 0], atol=1e-10)
        np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-14)


def test_bad_input_is_invalid_and_alone():
    x0, x1, F, K0, K1, R, _ = stack((7,))
    F[0] = 0
    F[1, 0, 0] = torch.nan
    K0[2] = 0
    K1[3, 0, 0] = torch.inf
    F[4] = torch.outer(F[4, 0], F[4, 1])  # rank one
    mask = torch.ones(7, 20, dtype=torch.bool)
    mask[5] = False
    pose = pose_from_fundamental(F, K0, K1, x0, x1, mask)
    assert pose.valid.tolist() == [False] * 6 + [True]
    assert torch.equal(pose.R[:6], torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    assert not pose.t[:6].any()
    torch.testing.assert_close(pose.R[6], R[6])


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


CAMERAS = np.array([650.0, 319.5, 239.5, 820, 300.5, 249.5])
K0, K1 = (np.array([[f, 0, x], [0, f, y], [0, 0, 1]]) for f, x, y in (CAMERAS[:3], CAMERAS[3:]))


def pose_of(F: np.ndarray, s: known_cameras.Scene, weight: np.ndarray) -> np.ndarray:
    out = np.full(13, np.nan)
    pose(np.ascontiguousarray(F), CAMERAS, s.x0, s.x1, weight, out)
    return out


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_it_is_that_of_all_decompositions(noise: float) -> None:
    for seed in range(10):
        s = known_cameras.scene(seed, 40, noise, outliers=0.2, cameras=(K0, K1))
        rng = np.random.default_rng(seed)
        F = known_cameras.fundamental(s.R, s.t, (K0, K1)) * rng.choice([-2, 3]) + 1e-7 * noise * rng.normal(size=(3, 3))
        weight = rng.uniform(0, 1, 40) * s.right
        out = pose_of(F, s, weight)
        tensors = [torch.from_numpy(value)[None] for value in (F, K0, K1, s.x0, s.x1)]
        graphed = pose_from_fundamental(*tensors, torch.ones(1, 40, dtype=torch.bool), torch.from_numpy(weight)[None])
        assert bool(graphed.valid)
        assert out[12] == 1
        np.testing.assert_allclose(out[:9].reshape(3, 3), graphed.R[0], atol=1e-9)
        np.testing.assert_allclose(out[9:12], graphed.t[0], atol=1e-9)
        R, t, _ = solvers.pose(F, K0, K1, s.x0[s.right], s.x1[s.right])
        np.testing.assert_allclose(out[:9].reshape(3, 3), R, atol=1e-6)
        np.testing.assert_allclose(out[9:12], t, atol=1e-6)
        if not noise:
            np.testing.assert_allclose(out[9:12], s.t, atol=1e-6)


def test_weights_decide_on_which_side_points_lie() -> None:
    """In both forms: three heavy matches of the true motion against seven light ones of its mirror image."""
    s = known_cameras.scene(1, 10, outliers=0.0, cameras=(K0, K1))
    F = known_cameras.fundamental(s.R, s.t, (K0, K1))
    mirrored = known_cameras.scene(1, 10, outliers=0.0, cameras=(K0, K1))
    e0, e1 = np.linalg.svd(F)[2][2], np.linalg.svd(F.T)[2][2]
    for x, e in ((mirrored.x0, e0[:2] / e0[2]), (mirrored.x1, e1[:2] / e1[2])):
        x[:7] = 2 * e - x[:7]  # on the other side of the epipole, on the same lines
    weight = np.r_[np.full(7, 0.1), np.full(3, 1.0)]
    heavy, light = pose_of(F, mirrored, weight), pose_of(F, mirrored, np.ones(10))
    tensors = [torch.from_numpy(value)[None] for value in (F, K0, K1, mirrored.x0, mirrored.x1)]
    mask = torch.ones(1, 10, dtype=torch.bool)
    for out, each in ((heavy, torch.from_numpy(weight)[None]), (light, None)):
        graphed = pose_from_fundamental(*tensors, mask, each)
        np.testing.assert_allclose(out[:9].reshape(3, 3), graphed.R[0], atol=1e-9)
        np.testing.assert_allclose(out[9:12], graphed.t[0], atol=1e-9)
    np.testing.assert_allclose(heavy[9:12], s.t, atol=1e-6)
    assert np.abs(light[:12] - heavy[:12]).max() > 0.1


@pytest.mark.parametrize("kind", ["zero", "NaN", "rank 1", "no matches"])
def test_where_there_is_none_all_is_zero(kind: str) -> None:
    s = known_cameras.scene(0, 10, cameras=(K0, K1))
    F = known_cameras.fundamental(s.R, s.t, (K0, K1))
    F = {"zero": 0 * F, "NaN": np.nan * F, "rank 1": np.outer(F[0], F[1]), "no matches": F}[kind]
    assert not pose_of(F, s, np.full(10, 0.0 if kind == "no matches" else 1.0)).any()
