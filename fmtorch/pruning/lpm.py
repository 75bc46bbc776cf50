"""Locality preserving matching: LPM (Ma et al., IJCV 2019)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.jit.batches import for_each_pair, kernels_serve
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, I8x1, inner, kernel, vector
from fmtorch.pruning.calibration import calibration_of
from fmtorch.pruning.neighbors import search

# `lpm` for one pair, compiled: the same costs


class Passes(NamedTuple):
    """Of each pass (p,) the cost up to which matches are kept, neighbours, and the agreement of motions that differ."""

    thresholds: F8x1
    neighbors: I8x1
    taus: F8x1


@kernel
def lpm_kernel(x0: F8x2, x1: F8x2, mask: B1x1, passes: Passes, out: F8x2) -> None:
    """`lpm.lpm` of x0, x1 (n, 2), mask (n,) -> out[0] (n,), 1 for matches that are kept; `lpm.lpm_cost` -> out[1]."""
    thresholds, neighbors, taus = passes
    n, m = len(mask), 0
    out[0], out[1] = 0, 1
    match, points = np.empty(n, np.int64), np.empty((2, n, 2))
    for i in range(n):
        finite = math.isfinite(x0[i, 0]) and math.isfinite(x0[i, 1])
        match[m] = i
        for k in range(2):
            points[0, m, k], points[1, m, k] = x0[i, k], x1[i, k]
        m += mask[i] and finite and math.isfinite(x1[i, 0]) and math.isfinite(x1[i, 1])
    points0, points1 = points[0, :m], points[1, :m]
    members, cost, total, done = np.arange(m), vector(m), np.zeros(m), 0
    for k in range(len(thresholds)):
        if done > 0 and len(members) < neighbors[k] + 4:
            continue
        _cost_kernel(points0, points1, members, neighbors[k], taus[k], cost)
        done += 1
        total += cost
        kept = 0
        members = np.empty(m, np.int64)
        for i in range(m):
            members[kept] = i
            kept += cost[i] <= thresholds[k]
        members = members[:kept]
    for i in range(m):
        out[0, match[i]] = cost[i] <= thresholds[done - 1]
        out[1, match[i]] = total[i] / done


@inner
def _cost_kernel(points0: Array, points1: Array, members: Array, K: int, tau: float, cost: Array) -> None:
    """The mean over the three neighbourhood sizes -> cost (n,); the neighbours are among the members."""
    n, width = len(points0), K + 3
    near0, near1 = np.empty((n, width), np.int64), np.empty((n, width), np.int64)
    search(points0, points0[members], near0)
    search(points1, points1[members], near1)
    for i in range(n):
        cost[i] = 0
        for scale in range(3):  # as in the tensor form: neighbours 1..K+2, 2..K+1, 3..K
            size = K + 2 - 2 * scale
            kept = 0
            for a in range(1 + scale, width - scale):
                place = 0
                for b in range(width):
                    if near0[i, a] == near1[i, b] and near0[i, a] >= 0:
                        place = b
                if scale < place < width - scale:
                    kept += not _differs_kernel(points0, points1, i, members[near0[i, a]], tau)
            cost[i] += (size - kept) / size
        cost[i] /= 3


@inner
def _differs_kernel(points0: Array, points1: Array, i: int, j: int, tau: float) -> Any:
    """Whether matches i and j move differently; never where one of the two does not move."""
    x, y = points1[i, 0] - points0[i, 0], points1[i, 1] - points0[i, 1]
    u, v = points1[j, 0] - points0[j, 0], points1[j, 1] - points0[j, 1]
    length, other = x * x + y * y, u * u + v * v
    cosine = (x * u + y * v) / math.sqrt(length * other)
    return cosine * min(length, other) / max(length, other) < tau


Pass = tuple[float, int, float]  # threshold lambda, neighbours K, tau

_DISTANCES_CPU, _DISTANCES_GPU = 2**18, 2**26  # between points that exist at a time
_LARGEST = 1e150  # coordinate whose square is surely a number


def lpm(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    mask: Bool[Tensor, "b n"] | None = None,
    thresholds: Sequence[float] = (0.8, 0.5),
    neighbors: Sequence[int] = (6, 6),
    taus: Sequence[float] = (0.2, 0.2),
) -> Bool[Tensor, "b n"]:
    """True for matches whose neighbourhoods in the two images hold the same matches, moving alike.

    The cost of a match is the mean over three neighbourhood sizes (K + 2, K, K - 2) of the share of its neighbours
    that are near in one image only or whose motion differs, ``cos(angle) * ratio of squared lengths < tau``. Two
    passes, each with its threshold lambda, K and tau: the second seeks neighbours among the matches that the first
    kept, if those are at least K + 4, and decides. Equal to the released code with exact neighbours, ties by index; a
    neighbour that does not exist, where matches are few, counts as lost.

    Points in any common unit. Non-finite points are dropped. Memory is linear in the number of matches. Raises
    ValueError for K below 4, and for options of different lengths.
    """
    passes = _passes(thresholds, neighbors, taus)
    if kernels_serve(x0.detach(), x1.detach()):
        return _compiled(x0, x1, mask, passes)[:, 0] > 0
    kept = torch.zeros(x0.shape[:2], dtype=torch.bool, device=x0.device)
    for pair, match, costs in _costs(x0, x1, mask, passes):
        kept[pair, match] = costs[-1] <= thresholds[len(costs) - 1]
    return kept


def lpm_cost(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    mask: Bool[Tensor, "b n"] | None = None,
    thresholds: Sequence[float] = (0.8, 0.5),
    neighbors: Sequence[int] = (6, 6),
    taus: Sequence[float] = (0.2, 0.2),
) -> Float[Tensor, "b n"]:
    """The mean of the costs of the passes of `lpm`, in [0, 1]; 1 for masked matches and non-finite points.

    The first pass sees all matches, the second those that the first kept: together they tell right matches from wrong
    ones better than either does. Arguments as `lpm`.
    """
    passes = _passes(thresholds, neighbors, taus)
    if kernels_serve(x0.detach(), x1.detach()):
        return _compiled(x0, x1, mask, passes)[:, 1].to(x0.dtype)
    cost = torch.ones(x0.shape[:2], dtype=torch.float64, device=x0.device)
    for pair, match, costs in _costs(x0, x1, mask, passes):
        cost[pair, match] = sum(costs[1:], costs[0]) / len(costs)
    return cost.to(x0.dtype)


def _compiled(x0: Tensor, x1: Tensor, mask: Tensor | None, passes: Sequence[Pass]) -> Float[Tensor, "b 2 n"]:
    """Of each match 1 if it is kept, and its cost, by the kernel."""
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    rows = [np.array(row, kind) for row, kind in zip(zip(*passes, strict=True), (float, np.int64, float), strict=True)]
    out = torch.empty(len(x0), 2, x0.shape[1], dtype=torch.float64)
    return for_each_pair(lpm_kernel, (x0, x1, mask), Passes(*rows), out=out, kind=torch.float64)


def _passes(thresholds: Sequence[float], neighbors: Sequence[int], taus: Sequence[float]) -> list[Pass]:
    """The options by pass; raises ValueError where they do not belong together."""
    counts = {"thresholds": len(thresholds), "neighbors": len(neighbors), "taus": len(taus)}
    if len(set(counts.values())) > 1 or not thresholds:
        said = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise ValueError(f"{said} values; they must have one for each pass, and there must be a pass")
    if min(neighbors) < 4:
        raise ValueError(f"neighbors is {neighbors}; each must be at least 4, so that the smallest neighbourhood has 2")
    return list(zip(thresholds, neighbors, taus, strict=True))


def _costs(
    x0: Tensor, x1: Tensor, mask: Tensor | None, passes: Sequence[Pass]
) -> Iterator[tuple[int, Int[Tensor, " n"], list[Float[Tensor, " n"]]]]:
    """Of each pair its matches and, for every pass that there was, the mean cost of each of them."""
    finite = torch.isfinite(x0).all(-1) & torch.isfinite(x1).all(-1)
    mask = finite if mask is None else finite & mask
    for pair, here in enumerate(mask):
        points = torch.stack([x0[pair][here], x1[pair][here]]).double()
        members = torch.arange(points.shape[1], device=points.device)
        costs: list[Tensor] = []
        for threshold, K, tau in passes:
            if not costs or len(members) >= K + 4:
                costs.append(_cost(points, members, K, tau) / 3)
                members = (costs[-1] <= threshold).nonzero()[:, 0]
        yield pair, here.nonzero()[:, 0], costs


def _cost(points: Float[Tensor, "2 n 2"], members: Int[Tensor, " m"], K: int, tau: float) -> Float[Tensor, " n"]:
    """Sum over the three neighbourhood sizes, between 0 and 3; the neighbours are among the members."""
    near0, near1 = (_among(members, nearest_points(x, x[members], K + 3)) for x in points)
    rank = torch.arange(K + 3, dtype=torch.int16, device=points.device)
    place = ((near0[:, :, None] == near1[:, None, :]) * rank).amax(-1)  # of a neighbour in near1; 0: nowhere
    place.masked_fill_(near0 < 0, 0)
    differs = _differs(points[1] - points[0], near0, tau)
    cost = torch.zeros(points.shape[1], dtype=torch.float64, device=points.device)
    for scale, size in enumerate((K + 2, K, K - 2)):  # as released: neighbours 1..K+2, 2..K+1, 3..K; 0 is the match
        ring = slice(1 + scale, K + 3 - scale)
        common = (place[:, ring] > scale) & (place[:, ring] < K + 3 - scale)
        kept = (common & ~differs[:, ring]).sum(-1)
        cost = cost + (size - kept).double() / size
    return cost


def _among(members: Int[Tensor, " m"], near: Int[Tensor, "n k"]) -> Int[Tensor, "n k"]:
    """Indices among the members as indices among all; -1 stays."""
    return torch.where(near >= 0, members[near], -1) if len(members) else near


def _differs(motion: Float[Tensor, "n 2"], near: Int[Tensor, "n k"], tau: float) -> Bool[Tensor, "n k"]:
    """Whether each neighbour moves otherwise; never where one of the two does not move (0 / 0 in the cosine)."""
    others = motion[near.clamp(min=0)]
    length, lengths = motion.square().sum(-1)[:, None], others.square().sum(-1)
    cosine = (motion[:, None] * others).sum(-1) / sqrt(length * lengths)
    return cosine * torch.minimum(length, lengths) / torch.maximum(length, lengths) < tau


class LPM:
    """`lpm` as a stage; or, `soft`, a stage that keeps every match and supplies ``prior``: P(inlier) by `lpm_cost`.

    `thresholds`, `neighbors`, `taus` hold one value for each of the two passes. calibration: of one minus the cost, see
    `Calibration`; needed by the soft form alone, which raises ValueError without it.
    """

    def __init__(
        self,
        *,
        thresholds: Sequence[float] = (0.8, 0.5),
        neighbors: Sequence[int] = (6, 6),
        taus: Sequence[float] = (0.2, 0.2),
        soft: bool = False,
        calibration: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        self._options: dict[str, Any] = {"thresholds": thresholds, "neighbors": neighbors, "taus": taus}
        self.calibration = calibration_of("LPM", soft, calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that keep their neighbourhoods, or with a prior."""
        if self.calibration is not None:
            return self.calibration(c, self.evidence(c))
        return c.keep(lpm(c.x0, c.x1, mask=c.mask, **self._options))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from: one minus the cost."""
        return 1 - lpm_cost(c.x0, c.x1, mask=c.mask, **self._options)


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
