"""Errors of poses and homographies; metrics of arrays, and as torchmetrics."""

import importlib
import importlib.util
import math
import sys
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fmtorch import metrics
from fmtorch.geometry import cross_matrix
from tests.geometry.scenes import scene
from tests.metrics.test_nsgd import VGA, random_pairs
from tests.reference import metrics as reference
from tests.reference import solvers
from tests.reference.homography import mapped

ERROR = st.floats(0, 40) | st.sampled_from([1.0, 5.0, 10.0, 15.0, 20.0, float("inf"), float("nan")])
ERRORS = st.lists(ERROR, min_size=1, max_size=20)
SIZE = torch.tensor([480, 640])
CORNERS = np.array([[0, 0], [639, 0], [639, 479], [0, 479]], np.float64)


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
    error = metrics.pose_error(R, turned, torch.eye(3, dtype=torch.float64), t)
    # Squared cosines are exact to 1e-16: an angle to 1e-16 / cos(angle / 2) rad, to the root of 1e-16 at 180 degrees.
    tolerance = 1e-11 if degrees < 179.5 else 1e-5
    assert error.rotation.item() == pytest.approx(degrees, abs=tolerance)
    assert error.translation.item() == pytest.approx(min(degrees, 180 - degrees), abs=1e-11)
    assert error.worst.item() == max(error.rotation.item(), error.translation.item())
    signed = metrics.pose_error(R, turned, torch.eye(3, dtype=torch.float64), t, up_to_sign=False)
    assert signed.translation.item() == pytest.approx(degrees, abs=tolerance)


def test_matches_scalar_reference() -> None:
    R, t, R_gt, t_gt = poses(0, 4, 5)
    error = metrics.pose_error(R, t, R_gt, t_gt)
    for i in range(4):
        for j in range(5):
            r = reference.rotation_angle(R[i, j].numpy(), R_gt[i, j].numpy())
            d = reference.direction_angle(t[i, j].numpy(), t_gt[i, j].numpy())
            assert (error.rotation[i, j].item(), error.translation[i, j].item()) == pytest.approx((r, d), rel=1e-9)


def test_bad_poses_are_the_worst() -> None:
    R, t, R_gt, t_gt = poses(1, 6)
    R[1], t[2], t[3], t_gt[4] = torch.nan, torch.inf, 0.0, 0.0
    error = metrics.pose_error(R, t, R_gt, t_gt)
    assert error.rotation[[1, 2]].tolist() == [180, 180]
    assert error.translation[[1, 2, 3, 4]].tolist() == [90, 90, 90, 0]
    assert metrics.pose_error(R, t, R_gt, t_gt, up_to_sign=False).translation[3].item() == 180


def test_gradients() -> None:
    inputs = [v.requires_grad_() for v in poses(2, 3)]
    assert torch.autograd.gradcheck(lambda *p: metrics.pose_error(*p).worst, inputs)
    R, t = (v.detach().requires_grad_() for v in inputs[:2])
    exact = metrics.pose_error(R, t, R.detach(), t.detach())
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
    error = metrics.fundamental_pose_error(*inputs)
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
        error = metrics.fundamental_pose_error(factor * s.F, s.K0, s.K1, s.x0, s.x1, s.R, 7 * s.t)
        assert error.worst.item() < 1e-8
    signed = metrics.fundamental_pose_error(s.F, s.K0, s.K1, s.x0, s.x1, s.R, -s.t, up_to_sign=False)
    assert signed.translation.item() == pytest.approx(180, abs=1e-5)


def test_gradient_of_a_fundamental_matrix() -> None:
    F, K0, K1, x0, x1, R, t = (a[0] for a in perturbed(1))
    pixels = torch.diag(torch.tensor([500.0, 500, 1], dtype=torch.float64))  # of unit size, for finite differences
    F, K0, K1 = pixels @ F @ pixels, pixels.inverse() @ K0, pixels.inverse() @ K1
    leaves = [a.requires_grad_() for a in (F / F.norm(), K0, K1)]

    def angles(F: Tensor, K0: Tensor, K1: Tensor) -> tuple[Tensor, Tensor]:
        return tuple(metrics.fundamental_pose_error(F, K0, K1, x0 / 500, x1 / 500, R, t))

    assert torch.autograd.gradcheck(angles, leaves)


def test_the_closest_pose_of_a_fundamental_matrix_is_the_reference() -> None:
    """Of random matrices, and of nearly right ones, whose best pose is the true one."""
    g = torch.Generator().manual_seed(4)
    F, K0, K1, _, _, R_gt, t_gt = perturbed(10)
    F = torch.cat([F, torch.randn(30, 3, 3, generator=g, dtype=torch.float64)])
    K0, K1, R_gt, t_gt = (torch.cat([v, v, v, v]) for v in (K0, K1, R_gt, t_gt))
    K0[10:], K1[10:] = torch.eye(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    error = metrics.closest_pose_error(F, K0, K1, R_gt, t_gt)
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
    error, closest = metrics.fundamental_pose_error(*inputs, mask), metrics.closest_pose_error(F, K0, K1, R, t)
    assert error.rotation[1:].tolist() == [180, 180]
    assert error.translation[1:].tolist() == [90, 90]
    assert float(error.worst[0]) < 90
    assert closest.rotation[1].item() == closest.translation[1].item() == 180


@given(ERRORS)
def test_auc_as_superglue(values: list[float]) -> None:
    thresholds = (5, 10, 20)
    auc = metrics.pose_auc(torch.tensor(values, dtype=torch.float64), thresholds)
    assert auc.tolist() == pytest.approx(reference.pose_auc(values, thresholds), abs=1e-12)


@given(ERRORS)
def test_map_as_oanet_and_maa_as_the_ransac_tutorial(values: list[float]) -> None:
    errors = torch.tensor(values, dtype=torch.float64)
    assert metrics.pose_map(errors).tolist() == pytest.approx(reference.pose_map(values, (5, 10, 20)), abs=1e-12)
    assert metrics.pose_maa(errors).item() == pytest.approx(reference.pose_maa(values), abs=1e-12)


@pytest.mark.parametrize("thresholds", [(), (0,), (-5.0,), (7,), (5, 12.5)])
def test_thresholds_that_are_no_multiples_are_refused(thresholds: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="thresholds are"):
        metrics.pose_map(torch.zeros(3), thresholds)
    with pytest.raises(ValueError, match="maximum is 0"):
        metrics.pose_maa(torch.zeros(3), 0)


def homographies(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.eye(3) + rng.uniform(-1, 1, (count, 3, 3)) * [[0.1, 0.1, 30], [0.1, 0.1, 30], [2e-4, 2e-4, 0]]


def test_corner_error_is_the_mean_over_four_corners() -> None:
    H, true = homographies(20), homographies(40)[20:]
    errors = metrics.corner_error(torch.from_numpy(H), torch.from_numpy(true), SIZE)
    moves = [mapped(a, CORNERS) - mapped(b, CORNERS) for a, b in zip(H, true, strict=True)]
    np.testing.assert_allclose(errors, np.linalg.norm(moves, axis=2).mean(1), rtol=1e-9)
    scaled = metrics.corner_error(-7 * torch.from_numpy(H), torch.from_numpy(true), SIZE)
    torch.testing.assert_close(scaled, errors)
    pairs = zip(torch.from_numpy(H), torch.from_numpy(true), strict=True)
    alone = torch.stack([metrics.corner_error(a, b, SIZE) for a, b in pairs])
    assert torch.equal(alone, errors)


def test_corner_error_of_what_has_no_image_is_infinite() -> None:
    horizon = torch.eye(3, dtype=torch.float64)
    horizon[2] = torch.tensor([1.0, 0, -639])  # zero at the right corners
    for H in (horizon, torch.zeros(3, 3), torch.full((3, 3), torch.nan)):
        assert metrics.corner_error(H, torch.eye(3), SIZE) == torch.inf
    with pytest.raises(ValueError, match="size0"):
        metrics.corner_error(torch.eye(3), torch.eye(3), torch.tensor([0, 640]))


def test_corner_error_has_gradients() -> None:
    H = torch.from_numpy(homographies(3)).requires_grad_()
    true = torch.from_numpy(homographies(6)[3:])
    assert torch.autograd.gradcheck(lambda x: metrics.corner_error(x, true, SIZE), H)
    metrics.corner_error(H, H.detach(), SIZE).sum().backward()  # at zero
    assert torch.isfinite(H.grad).all()


def test_right_matches_are_near_in_both_images() -> None:
    true = homographies(1)[0]
    x0 = np.random.default_rng(1).uniform(0, 400, (50, 2))
    x1 = mapped(true, x0) + np.random.default_rng(2).normal(0, 3, (50, 2))
    moves = mapped(np.linalg.inv(true), x1) - x0, mapped(true, x0) - x1
    distance = np.linalg.norm(moves, axis=2).mean(0)
    ends = (torch.from_numpy(x) for x in (x0, x1))
    right = metrics.right_of_homography(torch.from_numpy(true), *ends, mask=torch.arange(50) < 40)
    np.testing.assert_array_equal(right, (distance < 3) & (np.arange(50) < 40))
    assert 5 < int(right.sum()) < 40


RNG = np.random.default_rng(0)
F0, F1, R = RNG.normal(size=(3, 4, 3, 3))
X0, X1 = RNG.uniform(0, 400, (2, 4, 20, 2))
T = RNG.normal(size=(4, 3))
SIZES = np.array([[480, 640]] * 4)
CALLS: dict[str, tuple[Any, ...]] = {
    "sgd": (F0, F1, SIZES, SIZES), "nsgd": (F0, F1, SIZES, SIZES), "nsgd_released": (F0, F1, SIZES, SIZES),
    "inlier_rate": (F0, X0, X1, X0[..., 0] > 9, SIZES, SIZES), "ground_truth_inliers": (F0, X0, X1, SIZES, SIZES),
    "pose_error": (R, T, R[::-1], T[::-1]), "pose_auc": (T[:, 0],), "recall": (T,),
    "mean_recall": (T,), "pose_map": (T[:, 0],), "pose_maa": (T,),
    "fundamental_pose_error": (F0, np.eye(3) + 0 * R, np.eye(3) + 0 * R, X0, X1, R, T),
    "closest_pose_error": (F0, np.eye(3) + 0 * R, np.eye(3) + 0 * R, R, T),
    "corner_error": (F0, F1, SIZES), "right_of_homography": (F0, X0, X1),
}  # fmt: skip


def test_every_metric_is_called() -> None:
    functions = {name for name in metrics.__all__ if name.islower()}
    assert functions == CALLS.keys()


@pytest.mark.parametrize("name", CALLS)
def test_arrays_are_taken_as_tensors(name: str) -> None:
    function = getattr(metrics, name)
    expected = function(*(torch.from_numpy(np.ascontiguousarray(value)) for value in CALLS[name]))
    for arguments in (CALLS[name], [CALLS[name][0], *map(torch.tensor, map(np.ascontiguousarray, CALLS[name][1:]))]):
        result = function(*arguments)
        for a, b in zip(result, expected, strict=True):
            assert isinstance(a, torch.Tensor)
            assert torch.equal(a, b)


def test_a_size_may_be_a_tuple() -> None:
    tuples = metrics.nsgd(F0, F1, (480, 640), size1=[480, 640], key=np.arange(4))
    assert torch.equal(tuples, metrics.nsgd(F0, F1, SIZES, SIZES, key=torch.arange(4)))


def test_says_which_extra_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    monkeypatch.delitem(sys.modules, "fmtorch.metrics.torchmetrics", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'fmtorch\[metrics\]'"):
        importlib.import_module("fmtorch.metrics.torchmetrics")


def test_accumulates_over_batches() -> None:
    classes = importlib.import_module("fmtorch.metrics.torchmetrics")
    F_gt, F_est = random_pairs(0, 7)
    sizes, key = VGA.expand(7, 2), torch.arange(7)
    values = metrics.nsgd(F_gt, F_est, sizes, sizes, key=key, samples=50)
    values[3] = torch.nan
    mean, recall, mean_recall = classes.NSGD(samples=50), classes.Recall(threshold=0.1), classes.MeanRecall(maximum=0.1)
    for part in (slice(0, 4), slice(4, 4), slice(4, 7)):
        mean.update(F_gt[part], F_est[part], sizes[part], sizes[part], key[part])
        recall.update(values[part])
        mean_recall.update(values[part])
    expected = metrics.nsgd(F_gt, F_est, sizes, sizes, key=key, samples=50).mean()
    # Two sums in another order.
    torch.testing.assert_close(mean.compute(), expected, rtol=1e-14, atol=0)
    torch.testing.assert_close(recall.compute(), metrics.recall(values, 0.1), rtol=1e-14, atol=0)
    torch.testing.assert_close(mean_recall.compute(), metrics.mean_recall(values, 0.1), rtol=1e-14, atol=0)
    recall.reset()
    with pytest.warns(UserWarning, match="before the ``update`` method"):
        assert recall.compute().isnan()


def test_pose_errors_accumulate_over_batches() -> None:
    classes = importlib.import_module("fmtorch.metrics.torchmetrics")
    errors = torch.tensor([0.5, 3.0, torch.nan, 7.0, 12.0, 18.0, 40.0], dtype=torch.float64)
    parts = (errors[:4], errors[4:4], errors[4:])
    for metric, expected in (
        (classes.PoseAUC(), metrics.pose_auc(errors)),
        (classes.PoseAUC(thresholds=(7.5, 3)), metrics.pose_auc(errors, (7.5, 3))),
        (classes.PoseMAA(), metrics.pose_maa(errors)),
        (classes.PoseMAP(threshold=20), metrics.pose_map(errors, (20,))[0]),
    ):
        for part in parts:
            metric.update(part)
        torch.testing.assert_close(metric.compute(), expected, rtol=1e-14, atol=0)
        metric.reset()
        with pytest.warns(UserWarning, match="before the ``update`` method"):
            assert metric.compute().isnan().all()
