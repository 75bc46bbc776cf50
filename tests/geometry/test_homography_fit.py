"""The Sampson error of homographies and its Levenberg-Marquardt equal their definitions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from fmtorch.compiling.arrays import F4x2, F8x1, F8x2
from fmtorch.compiling.kernel import kernel
from fmtorch.geometry import homography_objective_kernels as objective
from fmtorch.geometry.homography_kernels import weighted_homography
from fmtorch.geometry.levenberg_marquardt_kernels import Schedule
from fmtorch.geometry.residual_kernels import SINGLES
from fmtorch.geometry.robust_losses import KERNELS
from fmtorch.geometry.sampson_objective_kernels import LOSSES, Weighted, loss_table
from tests.conftest import shared_path
from tests.geometry.test_homography import planar
from tests.reference import homography as reference

SCALE = 0.02
EPS32 = float(np.finfo(np.float32).eps)


@kernel
def of_matches(H: F8x1, points: F8x2, out: F8x1) -> None:
    for i in range(len(out)):
        out[i] = objective.HOMOGRAPHY.of_match(H, points[0, i], points[1, i], points[2, i], points[3, i])


@kernel
def of_rows(H: F4x2, rows: F4x2, out: F4x2) -> None:
    for i in range(len(out)):
        objective.store(out, i, objective.HOMOGRAPHY.of_row(H[0], rows, 6 * i))


def behind_the_horizon(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Matches of a plane whose horizon crosses image 0, some of them behind it, and the homography."""
    rng = np.random.default_rng(n)
    H = np.eye(3)
    H[2] = [1.2, 0.3, 1.0]
    x0 = rng.uniform(-0.5, 1, (n, 2))
    x1 = reference.mapped(H, x0) + 0.003 * rng.normal(size=(n, 2))
    x0[::10, 0], x1[::10] = -1.5, rng.uniform(-1, 1, (len(x1[::10]), 2))
    return np.ascontiguousarray(np.c_[x0, x1].T), H


CASES: list[Callable[[int], tuple[np.ndarray, np.ndarray]]] = [lambda n: planar(4, n, noise=0.005), behind_the_horizon]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("n", [1, 7, 32, 45])
def test_squared_distances(n: int, case: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> None:
    points, H = case(n)
    expected = np.array([reference.sampson_squared(H, x[:2], x[2:]) for x in points.T])
    single = np.empty(n)
    of_matches(H.ravel().copy(), points, single)
    np.testing.assert_allclose(single, expected, rtol=1e-10)
    rows, scale = np.zeros((-(-n // SINGLES) * 6, SINGLES), np.float32), 7.0
    for i in range(n):
        rows[i // SINGLES * 6 :, i % SINGLES][:5] = [*points[:, i], scale]
    many = np.empty((len(rows) // 6, SINGLES), np.float32)
    of_rows(H.reshape(1, 9).astype(np.float32), rows, many)
    distance = np.sqrt(many.ravel()[:n] / scale)
    finite = np.isfinite(expected)
    assert (np.isfinite(distance) == finite).all()
    # Equations of numbers of about one cancel to rounding of float32; their slope is no less than W.
    W = np.abs((np.c_[points[:2].T, np.ones(n)] @ H[2])[finite])
    assert (np.abs(distance[finite] - np.sqrt(expected[finite])) < 16 * EPS32 / np.minimum(W, 1)).all()
    of_matches(np.full(9, np.nan), points, single)
    assert not np.isfinite(single).any()


def weighted(points: np.ndarray, loss: str, seed: int = 0) -> Weighted:
    rng, n = np.random.default_rng(seed), points.shape[1]
    s2 = (SCALE * rng.uniform(0.5, 2, n)) ** 2
    return Weighted(points, rng.random(n), s2, LOSSES[loss], loss_table(loss))


def expected_cost(H: np.ndarray, data: Weighted, loss: str) -> float:
    squared = [min(reference.sampson_squared(H, x[:2], x[2:]), objective.FAR) for x in data.points.T]
    losses = KERNELS[loss].loss(torch.tensor(squared, dtype=torch.float64), torch.from_numpy(data.s2))
    return float((torch.from_numpy(data.weight) * losses).sum())


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("loss", LOSSES)
def test_cost_gradient_and_curvature(loss: str, case: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> None:
    points, truth = case(45)
    data, H = weighted(points, loss), truth.ravel()[None] + 0.01 * np.random.default_rng(1).normal(size=(3, 9))
    products, cost, alone = np.empty((3, 10, 10)), np.empty(3), np.empty(3)
    objective.evaluate_homographies(H, data, True, products, cost)
    objective.evaluate_homographies(H, data, False, np.empty((3, 10, 10)), alone)
    assert (cost == alone).all()
    np.testing.assert_allclose(cost, [expected_cost(h.reshape(3, 3), data, loss) for h in H], rtol=1e-10)
    np.testing.assert_array_equal(products, products.transpose(0, 2, 1))
    np.testing.assert_allclose(
        products[:, :9] @ np.c_[H, np.zeros(3)][:, :, None] / np.abs(products).max(), 0, atol=1e-4
    )
    step = 1e-6
    for k, h in enumerate(H):
        ends = [[expected_cost((h + s * step * e).reshape(3, 3), data, loss) for s in (1, -1)] for e in np.eye(9)]
        slope = np.diff(np.array(ends)[:, ::-1], axis=1)[:, 0] / (4 * step)  # half the gradient
        np.testing.assert_allclose(products[k, :9, 9], slope, atol=1e-5 * np.abs(slope).max())


def whitened_rows(h: np.ndarray, data: Weighted) -> np.ndarray:
    """The Jacobian of the residual vectors of all matches by the nine entries, by differences: (2 n, 9).

    R e with R^T R = (J J^T)^-1 held fixed where the error vanishes: at exact matches the Gauss-Newton matrix's factor.
    """
    rows = []
    for x, w in zip(data.points.T, data.weight, strict=True):
        H, n = h.reshape(3, 3), np.append(x[:2], 1)
        W = H[2] @ n
        J = np.column_stack([H[:2, :2] - np.outer(x[2:], H[2, :2]), -W * np.eye(2)])
        G = np.block([[n, np.zeros(3), -x[2] * n], [np.zeros(3), n, -x[3] * n]])
        rows.append(np.sqrt(w) * np.linalg.cholesky(np.linalg.inv(J @ J.T)).T @ G)
    return np.concatenate(rows)


def test_curvature_at_exact_matches() -> None:
    points, truth = planar(5, 33)
    data = weighted(points, "truncated")
    products, cost = np.empty((1, 10, 10)), np.empty(1)
    objective.evaluate_homographies(truth.reshape(1, 9), data, True, products, cost)
    rows = whitened_rows(truth.ravel(), data)
    np.testing.assert_allclose(products[0, :9, :9], rows.T @ rows, rtol=1e-9, atol=1e-9)
    assert cost[0] < 1e-25


def refined(H: np.ndarray, data: Weighted, iterations: int, tolerance: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    out, cost = np.empty_like(H), np.empty(len(H))
    objective.refine_homographies(H, data, Schedule(iterations, 1e-4, tolerance), out, cost)
    return out, cost


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("loss", LOSSES)
def test_refined_models_are_optima(loss: str, case: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> None:
    """Also where matches are behind the horizon: their loss is finite."""
    points, truth = case(200)
    data = weighted(points, loss)
    start = truth.ravel()[None] / np.linalg.norm(truth) + 0.002 * np.random.default_rng(3).normal(size=(3, 9))
    begun, (found, cost) = refined(start, data, 0)[1], refined(start, data, 60)
    assert (cost < begun).all()
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-14)
    rng = np.random.default_rng(4)
    for h, best in zip(found, cost, strict=True):
        for _ in range(20):
            near = h + 1e-4 * rng.normal(size=9)
            assert expected_cost(near.reshape(3, 3), data, loss) > best * (1 - 1e-12)


def test_refined_models_of_scales_and_signs() -> None:
    points, truth = planar(6, 80, noise=0.01)
    data = weighted(points, "cauchy")
    h = truth.ravel() / np.linalg.norm(truth)
    found, cost = refined(np.stack([h, 1e9 * h, 1e-9 * h]), data, 10)
    np.testing.assert_allclose(found, np.tile(found[0], (3, 1)), atol=1e-12)
    behind, infinite = refined(np.stack([-h, np.full(9, np.nan)]), data, 10)
    assert infinite[0] > cost[0]  # all behind the horizon
    assert not np.isfinite(infinite[1])
    assert np.isfinite(behind[0]).all()


def test_tolerance_ends_a_fit() -> None:
    points, truth = planar(7, 80, noise=0.01)
    data, h = weighted(points, "cauchy"), truth.reshape(1, 9)
    assert refined(h, data, 20, 1.0)[1] == refined(h, data, 1)[1]
    np.testing.assert_allclose(refined(h, data, 20, 1e-9)[1], refined(h, data, 20)[1], rtol=1e-8)


def test_planes_of_a_real_pair() -> None:
    """SIFT matches of the painted wall near its published homography, which is told to about a pixel."""
    folder = shared_path("data/planar/graf")
    images = [cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in ("graf1.png", "graf3.png")]
    file = cv2.FileStorage(str(folder / "H1to3p.xml"), cv2.FILE_STORAGE_READ)
    published: Any = file.getNode("H13").mat()
    keypoints, descriptors = zip(
        *(cv2.SIFT_create(3000).detectAndCompute(image, None) for image in images), strict=True
    )
    pairs = cv2.BFMatcher(cv2.NORM_L2, True).match(*descriptors)
    x0 = np.array([keypoints[0][m.queryIdx].pt for m in pairs])
    x1 = np.array([keypoints[1][m.trainIdx].pt for m in pairs])
    near = np.linalg.norm(reference.mapped(published, x0) - x1, axis=1) < 3
    x0, x1 = (x[near] - 400 for x in (x0, x1))
    assert len(x0) > 200
    points = np.ascontiguousarray(np.c_[x0, x1].T) / 400
    H, weight = np.empty(9), np.ones(len(x0))
    assert weighted_homography(points, weight, H)
    np.testing.assert_allclose(reference.unit(H.reshape(3, 3)), reference.dlt(points[:2].T, points[2:].T), atol=1e-9)
    data = Weighted(points, weight, np.full(len(x0), (1.5 / 400) ** 2), LOSSES["cauchy"], loss_table("cauchy"))
    found, cost = refined(H[None] * np.sign(H[8]), data, 20)
    assert cost[0] < expected_cost(H.reshape(3, 3) * np.sign(H[8]), data, "cauchy")
    away = reference.mapped(found[0].reshape(3, 3), points[:2].T) * 400 + 400 - reference.mapped(published, x0 + 400)
    assert np.median(np.linalg.norm(away, axis=1)) < 1
