"""Losses and layers of learned pruners from the definitions: one pair, match and point at a time."""

import numpy as np
import torch
from torch import Tensor

from tests.reference.metrics import border_points, distance, homogeneous

EPS = 1e-5


def context_norm(x: Tensor) -> Tensor:
    """Of one pair, (C, n): each channel to mean 0 and variance 1 (Yi et al., CVPR 2018, eq. 2 and 3)."""
    mean = x.mean(1, keepdim=True)
    variance = (x - mean).square().mean(1, keepdim=True)
    return (x - mean) / (variance + EPS).sqrt()


def context_batch_norm_relu(
    x: Tensor, mask: Tensor, weight: Tensor, bias: Tensor, running: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Context norm pair by pair, batch norm over all matches of the batch, ReLU; x (C, B, N)."""
    pairs = [context_norm(x[:, b, mask[b]]) for b in range(x.shape[1])]
    together = torch.cat(pairs, 1)
    if running is None:
        mean = together.mean(1)
        variance = (together - mean[:, None]).square().mean(1)
    else:
        mean, variance = running
    normal = (together - mean[:, None]) / (variance + EPS).sqrt()[:, None]
    y = torch.relu(weight[:, None] * normal + bias[:, None])
    padded = torch.zeros_like(x)
    padded[:, mask] = y
    return padded


def virtual_points(
    F: np.ndarray, size0: np.ndarray, size1: np.ndarray, uniforms: np.ndarray, count: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The first `count` draws (tries, 3) whose line meets image 1."""
    points: list[tuple[np.ndarray, np.ndarray]] = []
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


def geometric_loss(
    F_est: np.ndarray, points: list[tuple[np.ndarray, np.ndarray]], A0: np.ndarray, A1: np.ndarray, limit: float
) -> float:
    """Mean over points of the sum of squared distances from the lines of A1^T F A0, clamped."""
    F = A1.T @ F_est @ A0
    total = 0.0
    for m0, m1 in points:
        y0, y1 = (np.linalg.inv(A) @ homogeneous(m) for A, m in ((A0, m0), (A1, m1)))
        squared = distance(y1, F @ y0) ** 2 + distance(y0, F.T @ y1) ** 2
        total += min(squared, limit)
    return total / len(points)
