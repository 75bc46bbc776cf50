"""Locality preserving matching: LPM (Ma et al., IJCV 2019)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.jit.batches import for_each_pair
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, I8x1, inner, kernel, vector
from fmtorch.pruning.calibration import calibration_of
from fmtorch.pruning.neighbors import search


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
        _cost(points0, points1, members, neighbors[k], taus[k], cost)
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
def _cost(points0: Array, points1: Array, members: Array, K: int, tau: float, cost: Array) -> None:
    """The mean over the three neighbourhood sizes -> cost (n,); the neighbours are among the members."""
    n, width = len(points0), K + 3
    near0, near1 = np.empty((n, width), np.int64), np.empty((n, width), np.int64)
    search(points0, points0[members], near0)
    search(points1, points1[members], near1)
    for i in range(n):
        cost[i] = 0
        for scale in range(3):  # as released: neighbours 1..K+2, 2..K+1, 3..K; 0 is the match
            size = K + 2 - 2 * scale
            kept = 0
            for a in range(1 + scale, width - scale):
                place = 0
                for b in range(width):
                    if near0[i, a] == near1[i, b] and near0[i, a] >= 0:
                        place = b
                if scale < place < width - scale:
                    kept += not _differs(points0, points1, i, members[near0[i, a]], tau)
            cost[i] += (size - kept) / size
        cost[i] /= 3


@inner
def _differs(points0: Array, points1: Array, i: int, j: int, tau: float) -> Any:
    """Whether matches i and j move differently; never where one of the two does not move."""
    x, y = points1[i, 0] - points0[i, 0], points1[i, 1] - points0[i, 1]
    u, v = points1[j, 0] - points0[j, 0], points1[j, 1] - points0[j, 1]
    length, other = x * x + y * y, u * u + v * v
    cosine = (x * u + y * v) / math.sqrt(length * other)
    return cosine * min(length, other) / max(length, other) < tau


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
    The cost of a match is the mean over three neighbourhood sizes (K + 2, K, K - 2) of the share of its neighbours that
    are near in one image only or whose motion differs, ``cos(angle) * ratio of squared lengths < tau``. Two passes,
    each with its threshold lambda, K and tau: the second seeks neighbours among the matches that the first kept, if
    those are at least K + 4, and decides. Equal to the released code with exact neighbours, ties by index; a neighbour
    that does not exist, where matches are few, counts as lost.
    Points in any common unit. Non-finite points are dropped. Memory is linear in the number of matches. Computed on the
    CPU. Raises ValueError for K below 4, and for options of different lengths."""
    return _kept_and_cost(x0, x1, mask, _passes(thresholds, neighbors, taus))[:, 0] > 0


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
    ones better than either does. Arguments as `lpm`."""
    return _kept_and_cost(x0, x1, mask, _passes(thresholds, neighbors, taus))[:, 1].to(x0.dtype)


def _kept_and_cost(x0: Tensor, x1: Tensor, mask: Tensor | None, passes: Passes) -> Float[Tensor, "b 2 n"]:
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    out = torch.empty(len(x0), 2, x0.shape[1], dtype=torch.float64)
    return for_each_pair(lpm_kernel, (x0, x1, mask), passes, out=out, kind=torch.float64)


def _passes(thresholds: Sequence[float], neighbors: Sequence[int], taus: Sequence[float]) -> Passes:
    """The options by pass; raises ValueError where they do not belong together."""
    counts = {"thresholds": len(thresholds), "neighbors": len(neighbors), "taus": len(taus)}
    if len(set(counts.values())) > 1 or not thresholds:
        said = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise ValueError(f"{said} values; they must have one for each pass, and there must be a pass")
    if min(neighbors) < 4:
        raise ValueError(f"neighbors is {neighbors}; each must be at least 4, so that the smallest neighbourhood has 2")
    return Passes(np.array(thresholds, float), np.array(neighbors, np.int64), np.array(taus, float))


class LPM:
    """`lpm` as a stage; or, `soft`, a stage that keeps every match and supplies ``prior``: P(inlier) by `lpm_cost`.
    `thresholds`, `neighbors`, `taus` hold one value for each of the two passes. calibration: of one minus the cost, see
    `Calibration`; needed by the soft form alone, which raises ValueError without it."""

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
