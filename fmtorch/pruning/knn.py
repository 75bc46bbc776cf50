"""Exact nearest neighbours among points of the plane, in tensors; kernels take `knn_kernels`."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

_DISTANCES_CPU, _DISTANCES_GPU = 2**18, 2**26  # that exist at a time
_LARGEST = 1e150  # coordinate whose square is surely a number


def nearest_points(queries: Float[Tensor, "n 2"], points: Float[Tensor, "m 2"], count: int) -> Int[Tensor, "n count"]:
    """Indices of the `count` points nearest to each query, nearest first, ties by lowest index; -1 for no more points.

    By exhaustive search in float64. Memory linear in n + m.
    """
    nearest = torch.full((len(queries), count), -1, device=queries.device)
    if not (len(queries) and len(points)):
        return nearest
    queries, points = _in_range(queries.detach().double(), points.detach().double())
    distances = _DISTANCES_GPU if queries.is_cuda else _DISTANCES_CPU
    for rows in torch.split(torch.arange(len(queries), device=queries.device), max(1, distances // len(points))):
        dx, dy = (queries[rows, None, i] - points[:, i] for i in (0, 1))
        squared = dx.square_() + dy.square_()
        for k in range(min(count, len(points))):
            nearest[rows, k] = best = squared.argmin(1)  # the first of equals
            squared.scatter_(1, best[:, None], math.inf)
    return nearest


def _in_range(queries: Float[Tensor, "n 2"], points: Float[Tensor, "m 2"]) -> tuple[Tensor, Tensor]:
    """Both, divided by a power of two where squares of their coordinates would overflow."""
    largest = max(float(x.abs().max()) for x in (queries, points))
    if not _LARGEST < largest < math.inf:
        return queries, points
    exponent = math.frexp(largest)[1]
    return queries * 0.5**exponent, points * 0.5**exponent
