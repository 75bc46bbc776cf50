from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.geometry.irls import irls
from fmtorch.geometry.refine import refine
from fmtorch.geometry.robust_losses import LOSSES
from tests.conftest import oracle
from tests.geometry.scenes import unit_scene
from tests.geometry.test_refine import distance
from tests.reference import refine as reference


def pair(seed: int, noise: float, outliers: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    F, x0, x1 = (torch.from_numpy(v) for v in unit_scene(seed, 120, noise, outliers))
    return F, x0, x1


def cost(F: Tensor, x0: Tensor, x1: Tensor, loss: str, scale: float) -> float:
    r2 = reference.sampson(F.numpy(), x0.numpy(), x1.numpy()) ** 2
    return float(reference.loss(r2, scale**2, loss).sum())


def eight_point_once(F: np.ndarray, x0: np.ndarray, x1: np.ndarray, scale: float) -> np.ndarray:
    """One reweighted fit with the Cauchy loss, from the definition."""
    h0, h1 = np.c_[x0, np.ones(len(x0))], np.c_[x1, np.ones(len(x1))]
    line1, line0 = h0 @ F.T, h1 @ F
    g2 = (line1[:, :2] ** 2).sum(1) + (line0[:, :2] ** 2).sum(1)
    r2 = (h1 * line1).sum(1) ** 2 / g2
    w = scale**2 / (scale**2 + r2) / g2

    def similarity(x: np.ndarray) -> np.ndarray:
        c = (w[:, None] * x).sum(0) / w.sum()
        s = np.sqrt(2) * w.sum() / (w * np.linalg.norm(x - c, axis=1)).sum()
        return np.array([[s, 0, -s * c[0]], [0, s, -s * c[1]], [0, 0, 1]])

    T0, T1 = similarity(x0), similarity(x1)
    A = np.array([np.kron(b, a) for a, b in zip(h0 @ T0.T, h1 @ T1.T, strict=True)])
    linear = np.linalg.svd(np.sqrt(w)[:, None] * A)[2][-1].reshape(3, 3)
    U, s, Vt = np.linalg.svd(linear)
    fitted = T1.T @ (U[:, :2] * s[:2]) @ Vt[:2] @ T0
    return fitted / np.linalg.norm(fitted)


@pytest.mark.parametrize("seed", range(4))
def test_two_iterations_equal_the_definition(seed: int) -> None:
    F, x0, x1 = pair(seed, 2e-3, 20)
    fitted = irls(x0, x1, F, loss="cauchy", scale=0.01, iterations=2)
    expected = F.numpy()
    for _ in range(2):
        expected = eight_point_once(expected, x0.numpy(), x1.numpy(), 0.01)
    # The sums of products square the condition of the equations (some 1e3): 1e-16 * 1e6, and a little room.
    assert distance(fitted.flatten(), torch.from_numpy(expected.flatten())) < 1e-9


@pytest.mark.parametrize("loss", LOSSES)
def test_exact_matches_keep_the_exact_matrix(loss: str) -> None:
    F, x0, x1 = pair(5, 0.0)
    near = F + 1e-3 * torch.from_numpy(np.random.default_rng(0).normal(size=(3, 3)))
    fitted = irls(x0, x1, near, loss=loss, scale=1.0)
    assert distance(fitted.flatten(), F.flatten()) < 1e-9  # as above
    assert float(torch.linalg.svdvals(fitted)[2]) < 1e-15
    assert float(fitted.norm()) == pytest.approx(1, abs=1e-15)


def test_comes_close_to_the_optimum_on_real_pairs() -> None:
    data = oracle("robust.npz")
    for name in ("000", "001"):
        x0, x1, F = (torch.from_numpy(data[f"{name}.{key}"]) for key in ("X1", "X2", "F_gt"))
        fitted = irls(x0, x1, F, loss="cauchy", scale=1.0, iterations=10)
        best = refine(F, x0, x1, loss="cauchy", scale=1.0, iterations=30)
        start, end, optimum = (cost(m, x0, x1, "cauchy", 1.0) for m in (F, fitted, best))
        assert optimum <= end < start


def test_same_bits_in_any_batch_pool_and_padding() -> None:
    pairs = [pair(i, 3e-3, 30) for i in range(4)]
    F, x0, x1 = (torch.stack(v) for v in zip(*pairs, strict=True))
    pool = F[:, None] + 1e-2 * torch.from_numpy(np.random.default_rng(1).normal(size=(4, 5, 3, 3)))
    scale = torch.linspace(0.01, 0.02, 4, dtype=torch.float64)
    fitted = irls(x0, x1, pool, scale=scale, iterations=3)
    assert fitted.shape == pool.shape
    single = irls(x0[2], x1[2], pool[2, 3], scale=float(scale[2]), iterations=3)
    assert torch.equal(single, fitted[2, 3])
    y0, y1 = (torch.nn.functional.pad(v, (0, 0, 0, 77), value=torch.nan) for v in (x0, x1))
    mask = (torch.arange(197) < 120).expand(4, -1)
    assert torch.equal(irls(y0, y1, pool, mask=mask, scale=scale, iterations=3), fitted)


def test_hopeless_problems_keep_their_model() -> None:
    F, x0, x1 = pair(1, 1e-3)
    line = x0.clone()
    line[:, 1] = line[:, 0]
    points0 = torch.stack([x0, torch.full_like(x0, 0.5), torch.full_like(x0, torch.nan), line, x0])
    points1 = torch.stack([x1, torch.full_like(x1, 0.25), x1, line, x1])
    F0 = F.repeat(5, 1, 1)
    F0[4] = torch.nan
    fitted = irls(points0, points1, F0, scale=0.01)
    assert bool(torch.isfinite(fitted[:4]).all())
    assert bool((distance(fitted[1:4].flatten(1).T, F0[1:4].flatten(1).T) < 1e-14).all())
    assert bool(torch.isnan(fitted[4]).all())
    assert torch.equal(fitted[0], irls(x0, x1, F, scale=0.01))


def test_unknown_kernel() -> None:
    F, x0, x1 = pair(1, 0.0)
    with pytest.raises(ValueError, match="loss"):
        irls(x0, x1, F, loss="none")
