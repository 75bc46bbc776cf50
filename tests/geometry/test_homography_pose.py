"""Poses from homographies: OpenCV's decomposition, known cameras, rotations, degenerate input, the laws."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fmtorch.geometry import homography_points, poses_from_homography, rotation_from_homography

K0 = np.array([[900.0, 0, 500], [0, 920, 400], [0, 0, 1]])
K1 = np.array([[1100.0, 0, 520], [0, 1080, 380], [0, 0, 1]])


def plane(seed: int, n: int = 30, parallel: bool = False, length: float = 0.4) -> tuple[np.ndarray, ...]:
    """R, t, normal, the homography, and points (n, 2) of a plane that both cameras see; its distance is 1."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.normal(size=3) * 0.2).as_matrix()
    normal = np.array([*rng.normal(size=2) * 0.4, 1.0])
    normal /= np.linalg.norm(normal)
    t = R @ normal if parallel else rng.normal(size=3)
    t *= length * (rng.choice([-1, 1]) if parallel else 1) / np.linalg.norm(t)
    H = K1 @ (R + np.outer(t, normal)) @ np.linalg.inv(K0)
    x0 = rng.uniform([300, 250], [700, 550], (n, 2))
    return R, t, normal, H, x0


def tensors(*arrays: np.ndarray) -> list[Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(a)) for a in arrays]


def pairs(batch: tuple[int, ...], **options: object) -> list[Tensor]:
    """R, t, normal, H, K0, K1, x0, x1 of many planes."""
    many = [plane(i, **options) for i in range(int(np.prod(batch, dtype=int)))]  # type: ignore[arg-type]
    R, t, n, H, x0 = (torch.from_numpy(np.stack(a)).reshape(*batch, *a[0].shape) for a in zip(*many, strict=True))
    x1 = homography_points(H, x0)
    return [R, t, n, H, *(torch.from_numpy(K).expand(*batch, 3, 3) for K in (K0, K1)), x0, x1]


@pytest.mark.parametrize("batch", [(), (20,), (2, 3)])
@pytest.mark.parametrize("sign", [1.0, -1e-3])
def test_one_of_two_poses_is_the_true_one(batch: tuple[int, ...], sign: float) -> None:
    R, t, n, H, k0, k1, x0, x1 = pairs(batch)
    poses = poses_from_homography(sign * H, k0, k1, x0, x1)
    assert bool(poses.valid.any(-1).all())
    error = (poses.R - R[..., None, :, :]).abs().amax((-2, -1)) + (poses.t - t[..., None, :]).abs().amax(-1)
    error = error + (poses.normal - n[..., None, :]).abs().amax(-1)
    assert bool((error.amin(-1) < 1e-8).all())
    rebuilt = poses.R + poses.t[..., :, None] * poses.normal[..., None, :]
    true = (R + t[..., :, None] * n[..., None, :])[..., None, :, :]
    assert bool(((rebuilt - true).abs().amax((-2, -1)) < 1e-9)[poses.valid].all())
    torch.testing.assert_close(poses.R @ poses.R.mT, torch.eye(3).double().expand_as(poses.R), rtol=0, atol=1e-14)
    assert bool((poses.in_front[..., 0] >= poses.in_front[..., 1]).all())
    assert bool((poses.in_front[..., 0] == 1).all())


@pytest.mark.parametrize("seed", range(30))
def test_opencv(seed: int) -> None:
    """The valid poses are among the four of OpenCV, and those that it finds possible are valid."""
    _, _, _, H, x0 = plane(seed, length=0.1 + 0.05 * seed)
    x1 = homography_points(*tensors(H, x0)).numpy()
    G = np.linalg.inv(K1) @ H @ K0
    _, rotations, translations, normals = cv2.decomposeHomographyMat(G, np.eye(3))
    rays = [
        (np.c_[x, np.ones(len(x))] @ np.linalg.inv(K).T)[:, None, :2].astype(np.float32)
        for x, K in ((x0, K0), (x1, K1))
    ]
    possible = cv2.filterHomographyDecompByVisibleRefpoints(rotations, normals, *rays)
    poses = poses_from_homography(*tensors(H, K0, K1, x0, x1))
    computed = [
        np.concatenate([R.ravel(), t, n])
        for R, t, n, valid in zip(
            poses.R.numpy(), poses.t.numpy(), poses.normal.numpy(), poses.in_front == 1, strict=True
        )
        if valid
    ]
    expected = [
        np.concatenate([rotations[i].ravel(), translations[i][:, 0], normals[i][:, 0]]) for i in possible.ravel()
    ]
    assert len(computed) == len(expected)
    for solution in expected:
        assert min(np.abs(solution - ours).max() for ours in computed) < 1e-6


def test_motion_along_the_normal_and_rotations() -> None:
    R, t, _, H, k0, k1, x0, x1 = pairs((20,), parallel=True)
    poses = poses_from_homography(H, k0, k1, x0, x1)
    # The two normals meet: S is of rank one, and its minors, of which the roots are taken, are 1e-15 times some tens.
    assert bool(((poses.R - R[:, None]).abs().amax((-2, -1)) < 1e-4).all())
    assert bool(((poses.t - t[:, None]).abs().amax(-1) < 1e-4).all())
    H = torch.from_numpy(K1) @ R @ torch.from_numpy(np.linalg.inv(K0))
    turned = poses_from_homography(H, k0, k1, x0, homography_points(H, x0))
    assert bool(turned.valid.all())
    assert bool((turned.t.abs() < 1e-9).all())
    for sign in (1, -3.0):
        rotation, valid = rotation_from_homography(sign * H, k0, k1)
        assert bool(valid.all())
        torch.testing.assert_close(rotation, R, rtol=0, atol=1e-9)
    torch.testing.assert_close(turned.R[:, 0], R, rtol=0, atol=1e-9)


def test_the_nearest_rotation() -> None:
    """Of a matrix that is none: by singular values."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        G = Rotation.random(random_state=rng).as_matrix() + 0.2 * rng.normal(size=(3, 3))
        U, _, Vt = np.linalg.svd(G)
        expected = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        rotation, valid = rotation_from_homography(torch.from_numpy(G), torch.eye(3).double(), torch.eye(3).double())
        assert bool(valid)
        np.testing.assert_allclose(rotation.numpy(), expected, atol=1e-7)


def test_models_and_cameras_that_are_none_are_not_valid() -> None:
    _, _, _, H, k0, k1, x0, x1 = pairs((6,))
    mask = torch.ones(6, 30, dtype=torch.bool)
    H, k0 = H.clone(), k0.clone()
    H[0], H[1, 0, 0], H[2], k0[3], mask[4] = 0, torch.nan, torch.outer(H[2, 0], H[2, 1]), 0, False
    poses = poses_from_homography(H, k0, k1, x0, x1, mask)
    assert poses.valid.any(-1).tolist() == [False] * 5 + [True]
    assert torch.equal(poses.R[:5], torch.eye(3).double().expand(5, 2, 3, 3))
    assert rotation_from_homography(H, k0, k1)[1].tolist() == [False] * 4 + [True] * 2
