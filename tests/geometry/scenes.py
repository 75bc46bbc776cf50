"""Exact two-view scenes for the solvers' tests."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tests.reference.solvers import skew

SCALE = 0.02  # of losses at `near_scene`


class Scene(NamedTuple):
    x0: Tensor
    x1: Tensor
    F: Tensor
    K0: Tensor
    K1: Tensor
    R: Tensor
    t: Tensor


def scene(n: int, seed: int = 0, noise: float = 0.0, planar: bool = False) -> Scene:
    """n points in general position (or on a plane) 4 to 8 units ahead, seen by two cameras of some 1000 pixels."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.normal(size=3) * 0.2).as_matrix()
    t = rng.normal(size=3)
    t /= np.linalg.norm(t)
    X = rng.uniform([-2, -2, 4], [2, 2, 8], size=(n, 3))
    if planar:
        X[:, 2] = 6 + 0.3 * X[:, 0] - 0.2 * X[:, 1]
    K0 = np.array([[900.0, 0, 500], [0, 920, 400], [0, 0, 1]])
    K1 = np.array([[1100.0, 0, 520], [0, 1080, 380], [0, 0, 1]])
    y0, y1 = X @ K0.T, (X @ R.T + t) @ K1.T
    x0, x1 = y0[:, :2] / y0[:, 2:], y1[:, :2] / y1[:, 2:]
    x0, x1 = x0 + noise * rng.normal(size=x0.shape), x1 + noise * rng.normal(size=x1.shape)
    F = np.linalg.inv(K1).T @ skew(t) @ R @ np.linalg.inv(K0)
    F = F / np.linalg.norm(F)
    return Scene(*(torch.from_numpy(a) for a in (x0, x1, F, K0, K1, R, t)))


def scenes(batch: tuple[int, ...], n: int, seed: int = 0, noise: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    """x0, x1, F of independent scenes with any leading shape."""
    many = [scene(n, seed * 1000 + i, noise) for i in range(int(np.prod(batch, dtype=int)))]
    return tuple(torch.stack(list(a)).reshape(*batch, *a[0].shape) for a in list(zip(*many, strict=True))[:3])


def unit_scene(
    seed: int, n: int = 100, noise: float = 0.0, outliers: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F and matches of about unit scale before two cameras."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-2, 2, (n, 2)), rng.uniform(3, 7, n)]
    a, b = rng.uniform(-0.3, 0.3, 2)
    R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    R = R @ np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    t = rng.normal(size=3)
    t /= np.linalg.norm(t)
    F = skew(t) @ R
    Y = X @ R.T + t
    x0, x1 = X[:, :2] / X[:, 2:], Y[:, :2] / Y[:, 2:]
    x0, x1 = x0 + rng.normal(0, noise, x0.shape), x1 + rng.normal(0, noise, x1.shape)
    x1[:outliers] = rng.uniform(-1, 1, (outliers, 2))
    return F / np.linalg.norm(F), x0, x1


def distance(A: Tensor, B: Tensor) -> Tensor:
    """Of matrices (9, ...) of unit norm, up to sign."""
    return torch.minimum((A - B).norm(dim=0), (A + B).norm(dim=0))


def near_scene(seed: int, n: int = 24, noise: float = 3e-3, outliers: int = 3) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points of both images, a model near theirs and weights."""
    F, x0, x1 = (torch.from_numpy(v) for v in unit_scene(seed, n, noise, outliers))
    rng = np.random.default_rng(seed)
    near = F + 0.02 * torch.from_numpy(rng.normal(size=(3, 3)))
    return x0, x1, near, torch.from_numpy(rng.uniform(0.2, 1, n))


def tolerances(loss: str) -> dict[str, float | bool]:
    """Of `gradcheck`, along random directions. Central differences round 1e-15 times the condition 1e3 over the step.

    The tabulated loss is linear between its entries, 1 / 1000 apart, whose slopes differ by as much.
    """
    return {
        "eps": 1e-6,
        "atol": 1e-5,
        "rtol": 1e-3 if loss == "magsac" else 1e-5,
        "fast_mode": True,
        "check_undefined_grad": False,
    }
