"""Which matches are a model's inliers, given that neighbours tend to be alike: the labelling of Graph-Cut RANSAC.

Barath & Matas, "Graph-Cut RANSAC" (CVPR 2018), section 3. A labelling L (1: inlier, 0: outlier) of the matches has the
energy ``E(L) = sum_p B(L_p) + lambda sum_(p, q) R(L_p, L_q)`` over matches p and over the edges of a neighbourhood
graph, each counted once. With the kernel ``K = exp(-r^2 / (2 epsilon^2))`` of a match's residual,

    B(0) = K_p, B(1) = 1 - K_p;    R(0, 0) = (K_p + K_q) / 2, R(1, 1) = 1 - (K_p + K_q) / 2, R(0, 1) = R(1, 0) = 1.

This is the paper's form, which is followed here. The released code differs: ``K = 1 - r^2 / (1.5 epsilon)^2``, in B
not cut off below zero and with B(1) = 0; each edge counts from both ends; and lambda is 0.14 for the paper's 0.1.
The paper's neighbours are the matches within a ball of 20 px in the space of (x0, y0, x1, y1); so they are here, as far
as they are found close to each other along space-filling curves through that space.

E is submodular, and a least cut minimises it. Here it is minimised without one, many models at once: ``fixed_points``
encloses the least cut from above and below, and closes in on it everywhere but in the few matches on which the two
differ.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.geometry.curves import curve_order

WINDOW = 8  # candidates for neighbours before and after each match along each curve
SHIFTS = (0.0, 0.5)  # of the grid of each curve; the two find 97 % of the edges within 20 px of real pairs
SWEEPS = 8
_KERNEL_UNIT = 2.0**-10  # kernels are rounded to multiples of it, so that their sums are exact
_HALVINGS = 10  # exp(-z) is taken as (1 + z / 2^10)^-2^10
_FARTHEST = 20.0  # z from which on the kernel rounds to zero


@dataclasses.dataclass(frozen=True, eq=False)
class NeighborGraph:
    """An undirected graph over the matches of each of P pairs, as directed edges in both directions.

    head, tail: (edges,), positions in the P * N matches laid end to end. degree: (p, n).
    """

    head: Int[Tensor, " edges"]
    tail: Int[Tensor, " edges"]
    degree: Float[Tensor, "p n"]

    def sum(self, value: Float[Tensor, "p k n"]) -> Float[Tensor, "p k n"]:
        """The sum over each match's neighbours; exact for multiples of 2^-10 up to 1, so in any order."""
        p, k, n = value.shape
        end_to_end = value.transpose(1, 2).reshape(p * n, k)
        total = torch.zeros_like(end_to_end).index_add_(0, self.head, end_to_end[self.tail])
        return total.reshape(p, n, k).transpose(1, 2)


def neighbor_graph(pairs: NormalizedPairs, radius: float) -> NeighborGraph:
    """Matches within `radius` px of each other in (x0, y0, x1, y1), among those that are close along the curves."""
    points, mask = pairs.points.detach(), pairs.mask
    p, n = mask.shape
    limit = (radius / pairs.pixels_per_unit).square()[:, None]
    first = torch.arange(p, device=mask.device)[:, None] * n
    found = []
    for shift in SHIFTS:
        order = curve_order(points, mask, shift)  # matches of the mask first
        along = points.gather(2, order.expand(4, -1, -1))
        for step in range(1, WINDOW + 1):
            dx0, dy0, dx1, dy1 = (along[..., step:] - along[..., :-step]).square()
            near = (dx0 + dy0 + dx1 + dy1 <= limit) & mask[:, step:]
            one, other = (first + order)[:, :-step][near], (first + order)[:, step:][near]
            found += [one * (p * n) + other, other * (p * n) + one]
    edges = torch.unique(torch.cat(found))
    head, tail = edges // (p * n), edges % (p * n)
    degree = torch.bincount(head, minlength=p * n).reshape(p, n)
    return NeighborGraph(head, tail, degree.to(torch.float32))


def gaussian_kernel(squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``exp(-z / 2)`` of squared residuals z in units of epsilon, within 2^-10 of it and a multiple of that; float32.

    In arithmetic alone, because the last bits of a library's exp depend on where in memory a number stands.
    """
    value = 1 + (squared / 2).clamp_max(_FARTHEST).to(torch.float32) / (1 << _HALVINGS)
    for _ in range(_HALVINGS):
        value = value * value
    return (value.reciprocal() / _KERNEL_UNIT).round() * _KERNEL_UNIT


def energy(
    labels: Bool[Tensor, "p k n"],
    kernel: Float[Tensor, "p k n"],
    mask: Bool[Tensor, "p n"],
    graph: NeighborGraph,
    coherence: float,
) -> Float[Tensor, "p k"]:
    """E of each labelling; float64, exact but for its product with lambda. kernel: as `gaussian_kernel` rounds it."""
    inlier, K = labels.to(torch.float32), kernel
    unary = torch.where(labels, 1 - K, K)
    inliers, inlier_kernels = graph.sum(inlier), graph.sum(inlier * K)  # among each match's neighbours
    outliers, outlier_kernels = graph.degree[:, None] - inliers, graph.sum(K) - inlier_kernels
    of_inlier = outliers + inliers - (inliers * K + inlier_kernels) / 2
    of_outlier = inliers + (outliers * K + outlier_kernels) / 2
    pairwise = torch.where(labels, of_inlier, of_outlier)
    inside = mask[:, None]
    unary, pairwise = (torch.where(inside, value, 0).to(torch.float64).sum(-1) for value in (unary, pairwise))
    return unary + coherence / 2 * pairwise  # an edge was seen from both ends


def field(
    kernel: Float[Tensor, "p k n"], mask: Bool[Tensor, "p n"], graph: NeighborGraph, coherence: float
) -> Float[Tensor, "p k n"]:
    """h of ``E(L) = constant + sum_p h_p L_p - lambda sum_(p, q) L_p L_q``; infinite where there is no match.

    ``h_p = 1 - 2 K_p + lambda sum_q (1 - (K_p + K_q) / 2)``, from ``R = m + (1 - m) (L_p + L_q) - L_p L_q``.
    """
    pulled = graph.degree[:, None] * (1 - kernel / 2) - graph.sum(kernel) / 2
    return torch.where(mask[:, None], 1 - 2 * kernel + coherence * pulled, torch.inf)


def fixed_points(
    field: Float[Tensor, "p k n"], graph: NeighborGraph, coherence: float, sweeps: int = SWEEPS
) -> tuple[Bool[Tensor, "p k n"], Bool[Tensor, "p k n"]]:
    """A subset and a superset of the inliers of the least cut (of the one with fewest inliers, if there are several).

    The best label of a match given its neighbours' is 1 where ``h_p < lambda sum_q L_q``: monotone in the neighbours.
    Updated all together and starting from no inlier, labels therefore only ever turn to 1, and only where the least cut
    has 1; starting from all inliers they only turn to 0, and only where it has 0.
    """
    k = field.shape[1]
    both = torch.cat([field, field], 1)
    labels = torch.cat([torch.zeros_like(field), torch.isfinite(field).to(field.dtype)], 1)
    for _ in range(sweeps):
        before, labels = labels, (both < coherence * graph.sum(labels)).to(labels.dtype)
        if torch.equal(before, labels):
            break
    return labels[:, :k] > 0, labels[:, k:] > 0


def spatially_coherent_inliers(
    kernel: Float[Tensor, "p k n"], mask: Bool[Tensor, "p n"], graph: NeighborGraph, coherence: float
) -> Bool[Tensor, "p k n"]:
    """Labels of nearly the least energy: the better of the two that `fixed_points` encloses the least cut with."""
    inner, outer = fixed_points(field(kernel, mask, graph, coherence), graph, coherence)
    lower, upper = (energy(labels, kernel, mask, graph, coherence) for labels in (inner, outer))
    return torch.where((lower <= upper)[..., None], inner, outer)
