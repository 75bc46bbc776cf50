"""Matches of pairs that never were photographed, for measuring time and memory without any data."""

from __future__ import annotations

import numpy as np
import torch

from fmtorch.core.types import Correspondences

SIZE = (768, 1024)  # (h, w)


def synthetic_pair(index: int, matches: int, spread: float = 0.5) -> Correspondences:
    """Matches of a cloud of points seen by two cameras, with outliers, ratios and similarity frames.

    Their number is log-normal about `matches`; 30 to 80 % of them are right, with a noise of 0.5 px.
    """
    rng = np.random.default_rng(index)
    n = max(20, round(matches * np.exp(spread * rng.normal())))
    h, w = SIZE
    f = 1.2 * w
    depth = rng.uniform(4, 12, n)
    x0 = rng.uniform([0, 0], [w, h], (n, 2))
    X = np.concatenate([(x0 - [w / 2, h / 2]) / f, np.ones((n, 1))], 1) * depth[:, None]
    roll, yaw = rng.uniform(-0.3, 0.3, 2)
    R = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    moved = X @ R.T + [-8 * np.sin(yaw) + rng.uniform(-1, 1), rng.uniform(-0.3, 0.3), rng.uniform(-0.5, 0.5)]
    x1 = f * (moved[:, :2] / moved[:, 2:]) @ turn.T + [w / 2, h / 2]
    wrong = rng.random(n) > rng.uniform(0.3, 0.8)
    x1[wrong] = rng.uniform([0, 0], [w, h], (int(wrong.sum()), 2))
    x0, x1 = (x + rng.normal(0, 0.5, (n, 2)) for x in (x0, x1))
    ratio = np.where(wrong, rng.uniform(0.6, 0.8, n), rng.uniform(0.2, 0.8, n))
    angle = np.where(wrong, rng.uniform(-np.pi, np.pi, n), roll + rng.normal(0, 0.1, n))
    scale = np.where(wrong, np.exp(rng.normal(0, 0.7, n)), depth / moved[:, 2].clip(1) * np.exp(rng.normal(0, 0.1, n)))
    size = np.exp(rng.normal(1.5, 0.5, n))
    return Correspondences(
        _tensor(x0), _tensor(x1), torch.ones(1, n, dtype=torch.bool), quality=_tensor(ratio),
        lafs0=_tensor(_frames(x0, size, np.zeros(n))), lafs1=_tensor(_frames(x1, size * scale, angle)),
        size0=torch.tensor([SIZE]), size1=torch.tensor([SIZE]), key=torch.tensor([index + 1]),
    )  # fmt: skip


def _frames(x: np.ndarray, size: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Local affine frames (n, 2, 3) of a size and an orientation."""
    c, s = size * np.cos(angle), size * np.sin(angle)
    return np.stack([np.stack([c, -s, x[:, 0]], 1), np.stack([s, c, x[:, 1]], 1)], 1)


def _tensor(value: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(value.astype(np.float32))[None]
