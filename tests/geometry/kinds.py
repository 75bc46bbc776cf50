"""Synthetic pairs of each configuration."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fmtorch.core import PAIR_TYPES
from tests.reference.solvers import skew

K = np.array([[768.0, 0, 319.5], [0, 768, 239.5], [0, 0, 1]])
SIZE = (480, 640)


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
