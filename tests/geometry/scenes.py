"""Exact two-view scenes for the solvers' tests, and synthetic pairs of each type."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fmtorch.core import PAIR_TYPES
from tests.reference.solvers import skew

SCALE = 0.02  # of losses at `near_scene`
K = np.array([[768.0, 0, 319.5], [0, 768, 239.5], [0, 0, 1]])
SIZE = (480, 640)


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
    return stacked(batch, n, seed, noise)[:3]


def stacked(batch: tuple[int, ...], n: int, seed: int = 0, noise: float = 0.0) -> Scene:
    many = [scene(n, seed * 1000 + i, noise) for i in range(int(np.prod(batch, dtype=int)))]
    return Scene(*(torch.stack(list(a)).reshape(*batch, *a[0].shape) for a in zip(*many, strict=True)))


def unit_scene(seed: int, n: int = 100, noise: float = 0.0, outliers: int = 0) -> tuple[np.ndarray, ...]:
    """F and matches of about unit scale before two cameras."""
    rng = np.random.default_rng(seed)
    X = np.c_[rng.uniform(-2, 2, (n, 2)), rng.uniform(3, 7, n)]
    R = Rotation.from_euler("YX", rng.uniform(-0.3, 0.3, 2)).as_matrix()
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
    The tabulated loss is linear between its entries, 1 / 1000 apart, whose slopes differ by as much."""
    rtol = 1e-3 if loss == "magsac" else 1e-5
    return {"eps": 1e-6, "atol": 1e-5, "rtol": rtol, "fast_mode": True, "check_undefined_grad": False}


class Drawn(NamedTuple):
    """Matches (n, 2) in pixels, the F and H that a perfect estimator would give, and the motion."""

    x0: np.ndarray
    x1: np.ndarray
    F: np.ndarray
    H: np.ndarray
    R: np.ndarray
    t: np.ndarray


def draw(kind: str, seed: int, n: int = 200, wrong: float = 0.3, noise: float = 0.5, off_plane: int = 0) -> Drawn:
    """A pair of a kind; off_plane: matches of a planar one that are not on the plane."""
    rng = np.random.default_rng([seed, PAIR_TYPES.index(kind)])
    X = np.c_[rng.uniform(-2, 2, (n, 2)), rng.uniform(4, 8, n)]
    R = Rotation.from_rotvec(rng.normal(size=3) * 0.1).as_matrix()
    t = np.array([0.6, 0.1, 0.1])
    normal = np.array([-0.05, 0.02, 1 / 6])  # n^T X = 1
    if kind == "planar":
        X[off_plane:, 2] = (1 - X[off_plane:, :2] @ normal[:2]) / normal[2]
    if kind == "rotation":
        t, normal = np.zeros(3), np.zeros(3)
    x0, x1 = (Z @ K.T for Z in (X, X @ R.T + t))
    x0, x1 = x0[:, :2] / x0[:, 2:], x1[:, :2] / x1[:, 2:]
    inverse = np.linalg.inv(K)
    H = K @ (R + np.outer(t, normal)) @ inverse
    if kind == "identical":
        scale = rng.choice([1.0, 0.7])
        H = np.array([[scale, 0, 12.5], [0, scale, -3], [0, 0, 1]])
        x1 = scale * x0 + [12.5, -3]
    F = inverse.T @ skew(t) @ R @ inverse if kind in ("general", "planar") else skew(np.array([1.0, 2, 0.01])) @ H
    x0, x1 = x0 + rng.normal(0, noise, x0.shape), x1 + rng.normal(0, noise, x1.shape)
    k = n if kind == "unrelated" else round(wrong * n)
    x1[n - k :] = rng.uniform([0, 0], SIZE[::-1], (k, 2))
    return Drawn(x0, x1, F / np.linalg.norm(F), H / np.linalg.norm(H), R, t)


def batch(drawn: list[Drawn]) -> dict[str, Tensor]:
    """The arguments of `pair_evidence`, padded by what is not a number."""
    longest = max(len(d.x0) for d in drawn)
    points = np.full((2, len(drawn), longest, 2), np.nan)
    for i, d in enumerate(drawn):
        points[0, i, : len(d.x0)], points[1, i, : len(d.x1)] = d.x0, d.x1
    counts = torch.tensor([len(d.x0) for d in drawn])
    b = len(drawn)
    return {
        "F": torch.from_numpy(np.stack([d.F for d in drawn])), "H": torch.from_numpy(np.stack([d.H for d in drawn])),
        "x0": torch.from_numpy(points[0]), "x1": torch.from_numpy(points[1]),
        "mask": torch.arange(longest) < counts[:, None], "size0": torch.tensor([SIZE] * b),
        "size1": torch.tensor([SIZE] * b), "K0": torch.from_numpy(K).expand(b, 3, 3),
        "K1": torch.from_numpy(K).expand(b, 3, 3),
        "focal_precision": torch.diag_embed(torch.full((b, 2), 2500.0, dtype=torch.float64)),
    }  # fmt: skip
