"""Poses from fundamental matrices and from homographies: OpenCV, known cameras, degenerate input, gradients."""

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import motion_from_essential_choose_solution
from scipy.spatial.transform import Rotation
from torch import Tensor

from fmtorch.geometry import homography_points, pose_from_fundamental, poses_from_homography
from fmtorch.geometry.cameras import calibration_problems, mapped, square_pixels
from fmtorch.geometry.pose import pose
from tests.geometry.scenes import scene, stacked
from tests.reference import known_cameras, solvers

CAMERAS = np.array([650.0, 319.5, 239.5, 820, 300.5, 249.5])
CAMERA0, CAMERA1 = (np.array([[f, 0, x], [0, f, y], [0, 0, 1]]) for f, x, y in (CAMERAS[:3], CAMERAS[3:]))
K0 = np.array([[900.0, 0, 500], [0, 920, 400], [0, 0, 1]])
K1 = np.array([[1100.0, 0, 520], [0, 1080, 380], [0, 0, 1]])
SIZE = torch.tensor([[480, 640]])
GOOD = torch.tensor([[[500.0, 2, 310], [0, 520, 250], [0, 0, 1]]], dtype=torch.float64)
RIGHT = torch.tensor([True])


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_exact_pose(batch, dtype):
    x0, x1, F, CAMERA0, CAMERA1, R, t = stacked(batch, 20)
    sign = torch.where(torch.rand(*batch, 1, 1) < 0.5, 1, -1)
    pose = pose_from_fundamental(*(a.to(dtype) for a in (sign * F, CAMERA0, CAMERA1, x0, x1)))
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
    x0, x1, F, CAMERA0, CAMERA1, R, _ = stacked((7,), 20)
    F[0] = 0
    F[1, 0, 0] = torch.nan
    CAMERA0[2] = 0
    CAMERA1[3, 0, 0] = torch.inf
    F[4] = torch.outer(F[4, 0], F[4, 1])  # rank one
    mask = torch.ones(7, 20, dtype=torch.bool)
    mask[5] = False
    pose = pose_from_fundamental(F, CAMERA0, CAMERA1, x0, x1, mask)
    assert pose.valid.tolist() == [False] * 6 + [True]
    assert torch.equal(pose.R[:6], torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    assert not pose.t[:6].any()
    torch.testing.assert_close(pose.R[6], R[6])


def test_gradient():
    s = scene(20, 1, noise=1.0)
    pixels = torch.diag(torch.tensor([500.0, 500, 1], dtype=torch.float64))
    F = pixels @ s.F @ pixels
    scale = torch.tensor([500.0, 500.0], dtype=torch.float64)
    CAMERA0, CAMERA1 = (torch.linalg.inv(pixels) @ K for K in (s.K0, s.K1))
    F = (F / F.norm()).requires_grad_()

    def pose(F, CAMERA0, CAMERA1):
        return pose_from_fundamental(F, CAMERA0, CAMERA1, s.x0 / scale, s.x1 / scale)[:2]

    assert torch.autograd.gradcheck(pose, (F, CAMERA0.requires_grad_(), CAMERA1.requires_grad_()))


def pose_of(F: np.ndarray, s: known_cameras.Scene, weight: np.ndarray) -> np.ndarray:
    out = np.full(13, np.nan)
    pose(np.ascontiguousarray(F), CAMERAS, s.x0, s.x1, weight, out)
    return out


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_it_is_that_of_all_decompositions(noise: float) -> None:
    for seed in range(10):
        s = known_cameras.scene(seed, 40, noise, outliers=0.2, cameras=(CAMERA0, CAMERA1))
        rng = np.random.default_rng(seed)
        F = known_cameras.fundamental(s.R, s.t, (CAMERA0, CAMERA1)) * rng.choice([-2, 3])
        F += 1e-7 * noise * rng.normal(size=(3, 3))
        weight = rng.uniform(0, 1, 40) * s.right
        out = pose_of(F, s, weight)
        tensors = [torch.from_numpy(value)[None] for value in (F, CAMERA0, CAMERA1, s.x0, s.x1)]
        graphed = pose_from_fundamental(*tensors, torch.ones(1, 40, dtype=torch.bool), torch.from_numpy(weight)[None])
        assert bool(graphed.valid)
        assert out[12] == 1
        np.testing.assert_allclose(out[:9].reshape(3, 3), graphed.R[0], atol=1e-9)
        np.testing.assert_allclose(out[9:12], graphed.t[0], atol=1e-9)
        R, t, _ = solvers.pose(F, CAMERA0, CAMERA1, s.x0[s.right], s.x1[s.right])
        np.testing.assert_allclose(out[:9].reshape(3, 3), R, atol=1e-6)
        np.testing.assert_allclose(out[9:12], t, atol=1e-6)
        if not noise:
            np.testing.assert_allclose(out[9:12], s.t, atol=1e-6)


def test_weights_decide_on_which_side_points_lie() -> None:
    """In both forms: three heavy matches of the true motion against seven light ones of its mirror image."""
    s = known_cameras.scene(1, 10, outliers=0.0, cameras=(CAMERA0, CAMERA1))
    F = known_cameras.fundamental(s.R, s.t, (CAMERA0, CAMERA1))
    mirrored = known_cameras.scene(1, 10, outliers=0.0, cameras=(CAMERA0, CAMERA1))
    e0, e1 = np.linalg.svd(F)[2][2], np.linalg.svd(F.T)[2][2]
    for x, e in ((mirrored.x0, e0[:2] / e0[2]), (mirrored.x1, e1[:2] / e1[2])):
        x[:7] = 2 * e - x[:7]  # on the other side of the epipole, on the same lines
    weight = np.r_[np.full(7, 0.1), np.full(3, 1.0)]
    heavy, light = pose_of(F, mirrored, weight), pose_of(F, mirrored, np.ones(10))
    tensors = [torch.from_numpy(value)[None] for value in (F, CAMERA0, CAMERA1, mirrored.x0, mirrored.x1)]
    mask = torch.ones(1, 10, dtype=torch.bool)
    for out, each in ((heavy, torch.from_numpy(weight)[None]), (light, None)):
        graphed = pose_from_fundamental(*tensors, mask, each)
        np.testing.assert_allclose(out[:9].reshape(3, 3), graphed.R[0], atol=1e-9)
        np.testing.assert_allclose(out[9:12], graphed.t[0], atol=1e-9)
    np.testing.assert_allclose(heavy[9:12], s.t, atol=1e-6)
    assert np.abs(light[:12] - heavy[:12]).max() > 0.1


@pytest.mark.parametrize("kind", ["zero", "NaN", "rank 1", "no matches"])
def test_where_there_is_none_all_is_zero(kind: str) -> None:
    s = known_cameras.scene(0, 10, cameras=(CAMERA0, CAMERA1))
    F = known_cameras.fundamental(s.R, s.t, (CAMERA0, CAMERA1))
    F = {"zero": 0 * F, "NaN": np.nan * F, "rank 1": np.outer(F[0], F[1]), "no matches": F}[kind]
    assert not pose_of(F, s, np.full(10, 0.0 if kind == "no matches" else 1.0)).any()


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
    rays = [np.float32(cv2.undistortPoints(x, K, None)) for x, K in ((x0, K0), (x1, K1))]
    possible = cv2.filterHomographyDecompByVisibleRefpoints(rotations, normals, *rays)
    poses = poses_from_homography(*tensors(H, K0, K1, x0, x1))
    computed = torch.cat([poses.R.flatten(1), poses.t, poses.normal], 1)[poses.in_front == 1].numpy()
    expected = [np.r_[rotations[i].ravel(), translations[i][:, 0], normals[i][:, 0]] for i in possible.ravel()]
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
    torch.testing.assert_close(turned.R[:, 0], R, rtol=0, atol=1e-9)


def test_models_and_cameras_that_are_none_are_not_valid() -> None:
    _, _, _, H, k0, k1, x0, x1 = pairs((6,))
    mask = torch.ones(6, 30, dtype=torch.bool)
    H, k0 = H.clone(), k0.clone()
    H[0], H[1, 0, 0], H[2], k0[3], mask[4] = 0, torch.nan, torch.outer(H[2, 0], H[2, 1]), 0, False
    poses = poses_from_homography(H, k0, k1, x0, x1, mask)
    assert poses.valid.any(-1).tolist() == [False] * 5 + [True]
    assert torch.equal(poses.R[:5], torch.eye(3).double().expand(5, 2, 3, 3))


def test_they_are_those_of_the_definition() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        K = np.array([[rng.uniform(300, 900), rng.normal(0, 5), 320], [0, rng.uniform(300, 900), 240], [0, 0, 1]])
        A, square = known_cameras.square(K, (480, 640))
        for scale in (1.0, -2.0):  # K is homogeneous
            square_map = square_pixels(torch.from_numpy(scale * K)[None], SIZE, RIGHT)
            np.testing.assert_allclose(square_map.map[0], A, rtol=1e-12, atol=1e-9)
            assert float(square_map.focal) == pytest.approx(square[0, 0], rel=1e-12)
        x = rng.uniform(0, 600, (1, 50, 2))
        expected = np.c_[x[0], np.ones(50)] @ A.T
        np.testing.assert_allclose(mapped(torch.from_numpy(x), square_map.map)[0], expected[:, :2], atol=1e-9)


def test_an_image_of_unknown_size_is_central() -> None:
    square_map = square_pixels(GOOD, None, RIGHT)
    assert square_map.size.tolist() == [[501.0, 621.0]]
    middle = mapped(torch.tensor([[[310.0, 250.0]]], dtype=torch.float64), square_map.map)
    torch.testing.assert_close(middle, torch.tensor([[[310.0, 250.0]]], dtype=torch.float64))


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e3, 1e9])
@pytest.mark.parametrize("central", [True, False])
def test_the_unit_of_normalised_points_does_not_matter(scale: float, central: bool) -> None:
    """They are mapped to an image of 1000 px of focal length; pixels keep their unit."""
    K = torch.diag(torch.tensor([1.5, 1.5, 1.0], dtype=torch.float64))
    K[:2, 2] = torch.tensor([0.5, 0.4]) if central else 0.0
    K[:2] *= scale
    square_map = square_pixels(K[None], None, RIGHT)
    assert float(square_map.focal) == pytest.approx(1500.0 if scale == 1e3 else 1000.0)
    point = K[:2, 2] + K[0, 0] * torch.tensor([0.3, -0.2])
    (at,) = mapped(point[None, None], square_map.map)[0]
    centre = (square_map.size[0].flip(0) - 1) / 2
    torch.testing.assert_close((at - centre) / square_map.focal, torch.tensor([0.3, -0.2], dtype=torch.float64))


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ([(0, 0, np.nan)], "not finite"),
        ([(0, 0, 0.0)], "singular"),
        ([(2, 2, 0.0)], "singular"),
        ([(1, 0, 3.0)], "rows must be"),
        ([(2, 1, 1e-3)], "rows must be"),
        ([(1, 1, -520.0)], "must be positive"),
        ([(0, 0, 4.2), (1, 1, 4.2)], "in pixels"),
        ([(0, 2, 900e3)], "far outside an image of 640 x 480"),
        ([(1, 2, -5e6)], "far outside an image of 640 x 480"),
    ],
)
def test_what_is_no_calibration_is_named(entries: list[tuple[int, int, float]], said: str) -> None:
    K = GOOD.repeat(3, 1, 1)
    for i, j, value in entries:
        K[1, i, j] = value
    problems = calibration_problems(K, SIZE.expand(3, 2), "K1")
    assert problems[::2] == ("", "")
    assert problems[1].startswith("K1 ")
    assert said in problems[1]
    square = square_pixels(K, SIZE.expand(3, 2), torch.tensor([True, False, True]))
    assert bool(square.map.isfinite().all())
    assert torch.equal(square.map[1], torch.eye(3, dtype=torch.float64))
