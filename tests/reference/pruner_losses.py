"""Losses and layers of learned pruners from the definitions: one pair, match and point at a time."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import batch_norm, instance_norm

from tests.reference.metrics import Array, border_points, distance, homogeneous

EPS = 1e-5


def context_batch_norm_relu(x: Tensor, mask: Tensor, weight: Tensor, bias: Tensor, running: Any = None) -> Tensor:
    """Context norm pair by pair, batch norm over all matches of the batch, ReLU; x (C, B, N); running: mean, variance.
    Yi et al., CVPR 2018, equations 2 and 3."""
    alone = torch.cat([instance_norm(x[None, :, b, mask[b]], eps=EPS)[0] for b in range(x.shape[1])], 1)
    # by columns of matches in the order of pairs, as the mask picks them
    mean, variance = running or (None, None)
    normal = batch_norm(alone.T, mean, variance, weight, bias, training=running is None, eps=EPS)
    padded = torch.zeros_like(x)
    padded[:, mask] = torch.relu(normal.T)
    return padded


def virtual_points(F: Array, size0: Array, size1: Array, uniforms: Array, count: int) -> list[tuple[Array, Array]]:
    """The first `count` draws (tries, 3) whose line meets image 1."""
    points: list[tuple[Array, Array]] = []
    for u in uniforms:
        m = np.array([u[0] * size0[1] - 0.5, u[1] * size0[0] - 0.5])
        ends = border_points(F @ homogeneous(m), size1, -0.5)
        if ends is not None and len(points) < count:
            points.append((m, ends[0] + u[2] * (ends[1] - ends[0])))
    return points


def by_size(size: np.ndarray) -> np.ndarray:
    """From [-1, 1] along the longer side, 0 at the middle, to pixels."""
    h, w = size
    return np.array([[max(h, w) / 2, 0, (w - 1) / 2], [0, max(h, w) / 2, (h - 1) / 2], [0, 0, 1.0]])


def geometric_loss(F_est: Array, points: list[tuple[Array, Array]], A0: Array, A1: Array, limit: float) -> float:
    """Mean over points of the sum of squared distances from the lines of A1^T F A0, clamped."""
    F = A1.T @ F_est @ A0
    total = 0.0
    for m0, m1 in points:
        y0, y1 = (np.linalg.inv(A) @ homogeneous(m) for A, m in ((A0, m0), (A1, m1)))
        squared = distance(y1, F @ y0) ** 2 + distance(y0, F.T @ y1) ** 2
        total += min(squared, limit)
    return total / len(points)
