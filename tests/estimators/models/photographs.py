"""Matches of two whole photographs whose cameras are known."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from fmtorch.core import Correspondences
from tests.reference import focal as reference
from tests.reference.solvers import skew

WIDE, TALL = (640, 960), (1000, 700)  # (h, w)
Sizes = tuple[tuple[int, int], tuple[int, int]]


class Photographs(NamedTuple):
    """Matches, the true F of unit norm in pixels, and its parameters as in `reference.focal`."""

    c: Correspondences
    F: np.ndarray
    parameters: np.ndarray


def photographs(
    seed: int, sizes: Sizes = (WIDE, TALL), focal: tuple[float, float] = (1.1, 1.4), count: int = 200,
    noise: float = 0.2, outliers: float = 0.2, relief: float = 1.0, shift: float = 0.0,
) -> Photographs:  # fmt: skip
    """A scene of some relief (0: a plane) from two sides. shift: of the principal points, px."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1.2, 1.2, (count, 2)), rng.uniform(-1, 1, (count, 1)) * relief + 5], 1)
    rotation, t = np.array([0.02, 0.35, 0.05]) + rng.uniform(-0.05, 0.05, 3), np.array([-1.5, 0.1, 0.3])
    K = [reference.calibration(f, size) for f, size in zip(focal, sizes, strict=True)]
    for each in K:
        each[:2, 2] += shift
    R = Rotation.from_rotvec(rotation).as_matrix()
    x0, x1 = ((Y / Y[:, 2:]) @ k.T for Y, k in ((X, K[0]), (X @ R.T + t, K[1])))
    x0, x1 = (x[:, :2] + rng.normal(0, noise, (count, 2)) for x in (x0, x1))
    wrong = rng.random(count) < outliers
    x1[wrong] = rng.uniform([0, 0], sizes[1][::-1], (int(wrong.sum()), 2))
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, count, dtype=torch.bool),
        size0=torch.tensor(sizes[:1]), size1=torch.tensor(sizes[1:]), key=torch.tensor([seed + 1]),
    )  # fmt: skip
    F = np.linalg.inv(K[1]).T @ skew(t) @ R @ np.linalg.inv(K[0])
    return Photographs(c, F / np.linalg.norm(F), np.concatenate([rotation, t / np.linalg.norm(t), np.log(focal)]))


def with_prior(c: Correspondences, seed: int = 0) -> Correspondences:
    """Random priors."""
    prior = np.random.default_rng(seed).uniform(0.1, 1, tuple(c.mask.shape))
    return c.replace(prior=torch.from_numpy(prior))
