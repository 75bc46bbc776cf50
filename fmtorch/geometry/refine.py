"""Non-linear refinement of fundamental matrices: Levenberg-Marquardt of the robust Sampson error.

Minimises ``sum_i w_i rho(r_i^2)``, r the Sampson distance, over the 7-dimensional manifold of 3 x 3 matrices of rank 2
and unit norm. The tangent space at F is what is orthogonal, in R^9, to F (scale) and to ``e1 e0^T`` (rank), with
``F e0 = 0`` and ``F^T e1 = 0`` the epipoles; a step is taken in it and brought back along ``e1 e0^T`` to determinant
zero, which is linear in that direction. This is the orthonormal parametrisation of Bartoli & Sturm (2004) to first
order, without its rotations, and without its defect where the singular values coincide.

Everything is element-wise or summed in a fixed order, so a model is refined to the same bits in any batch.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.reduce import component_sum, stable_sum
from fmtorch.geometry.robust_kernels import Kernel, kernel

LANES = 64  # points are summed one by one into so many lanes, and these in a tree: part of the result's last bits
TILE_MODELS = 8  # models whose sums stay in the L2 cache together; changes no result
TILE_ELEMENTS = 1 << 13  # points times models of one step; changes no result
TINY = 1e-30  # squared slope of the epipolar constraint below which it is taken for this
DAMPING = 1e-4  # initial, relative to the mean curvature; divided or multiplied by 10 at each step
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-12, 1e6
STEP_DAMPING = 1e-10  # of the attached step: bounds its gradient where the points leave a direction open

Blocks = tuple[Tensor, Tensor]  # points (4, M, P, 1, LANES) and weights (M, P, 1, LANES)


def refine_components(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    kernel_name: str,
    scale: Float[Tensor, " p"],
    iterations: int,
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"]]:
    """Refined models and their costs ``sum_i w_i rho(r_i^2)``, component by component, without gradients.

    F: k models for each of p pairs, entries row by row; made rank 2 first where they are not. points: x0, y0, x1, y1,
    of about unit scale; finite. weight: 0 in padded slots. scale: of the kernel, in the unit of the points.
    The cost of a model never rises above that of its (rank-2) start; a model that cannot be improved is kept, one that
    is not finite comes back as it was, with infinite cost.
    """
    robust = kernel(kernel_name)
    with torch.no_grad():
        data = blocks(points, weight)
        s2 = scale.square()[:, None]
        state = _State(*start(F), data, robust, s2, iterations > 0)
        damping = torch.full_like(state.cost, DAMPING)
        for i in range(iterations):
            step = solve(state.normal, state.F, state.e0, state.e1, damping)
            trial = _State(*retract(state.F, step, state.e0, state.e1), data, robust, s2, i + 1 < iterations)
            better = trial.cost < state.cost
            damping = torch.where(better, damping / 10, damping * 10).clamp_(SMALLEST_DAMPING, LARGEST_DAMPING)
            state = trial.where(better, state)
        kept = torch.isfinite(state.cost)
        return torch.where(kept, state.F, F), torch.where(kept, state.cost, torch.inf)


class _State:
    """A rank-2 model, its epipoles and cost, and the normal equations there."""

    def __init__(
        self, F: Tensor, e0: Tensor, e1: Tensor, data: Blocks, robust: Kernel, s2: Tensor, derivatives: bool
    ) -> None:
        self.F, self.e0, self.e1 = F, e0, e1
        self.normal, self.cost = accumulate(F, data, robust, s2, derivatives)

    def where(self, condition: Tensor, other: _State) -> _State:
        """This state where the condition holds, the other elsewhere."""
        chosen = object.__new__(_State)
        chosen.F = torch.where(condition, self.F, other.F)
        chosen.e0 = torch.where(condition, self.e0, other.e0)
        chosen.e1 = torch.where(condition, self.e1, other.e1)
        chosen.normal = torch.where(condition, self.normal, other.normal) if len(self.normal) else self.normal
        chosen.cost = torch.where(condition, self.cost, other.cost)
        return chosen


def blocks(points: Float[Tensor, "4 p n"], weight: Float[Tensor, "p n"]) -> Blocks:
    """Points and weights cut into blocks of LANES, the last one padded with zeros of weight zero."""
    p, n = weight.shape
    m = -(-n // LANES)
    if n < m * LANES:
        points = torch.nn.functional.pad(points, (0, m * LANES - n))
        weight = torch.nn.functional.pad(weight, (0, m * LANES - n))
    points = points.reshape(4, p, m, 1, LANES).transpose(1, 2).contiguous()
    return points, weight.reshape(p, m, 1, LANES).transpose(0, 1).contiguous()


def accumulate(
    F: Float[Tensor, "9 p k"], data: Blocks, robust: Kernel, s2: Float[Tensor, "p 1"], derivatives: bool
) -> tuple[Float[Tensor, "rows columns p k"], Float[Tensor, "p k"]]:
    """The weighted products of Jacobian and residual, [[J^T W J, J^T W r], [.., r^T W r]] (10, 10, p, k), and the cost.

    W holds the weights times those of the kernel. Without derivatives the first is empty.
    Each lane adds its points one after the other, so zeros at the end change nothing.
    """
    p, k = F.shape[1:]
    normals, costs = [], []
    pairs = max(1, TILE_MODELS // k)
    for i in range(0, p, pairs):
        some = slice(i, i + pairs)
        tiles = [
            _accumulate(F[:, some, j : j + TILE_MODELS], (data[0][:, :, some], data[1][:, some]), robust, s2[some],
                        derivatives)
            for j in range(0, k, TILE_MODELS)
        ]  # fmt: skip
        normals.append(_join([t[0] for t in tiles]))
        costs.append(_join([t[1] for t in tiles]))
    return _join(normals, -2), _join(costs, -2)


def _join(parts: list[Tensor], dim: int = -1) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim)


def _accumulate(F: Tensor, data: Blocks, robust: Kernel, s2: Tensor, derivatives: bool) -> tuple[Tensor, Tensor]:
    points, weight = data
    m = len(weight)
    f, s2 = F[..., None], s2[..., None]
    count = max(1, TILE_ELEMENTS // f[0].numel() // LANES)
    lanes: list[Tensor] = []
    products: Tensor | None = None
    for first in range(0, m, count):
        some = slice(first, first + count)
        rows, inverse, r2 = linearise(f, points[:, some], derivatives)
        w = weight[some]
        lanes += (robust.loss(r2, s2) * w).unbind(0)
        if not derivatives:
            continue
        A = torch.stack(rows, 1)
        B = A * (robust.weight(r2, s2) * w * inverse)[:, None]
        for a, b in zip(A[:, :, None].unbind(0), B[:, None].unbind(0), strict=True):
            products = a * b if products is None else products.addcmul_(a, b)
    cost = lanes[0]
    for lane in lanes[1:]:
        cost = cost + lane
    return F.new_zeros(0) if products is None else stable_sum(products), stable_sum(cost)


def linearise(
    f: Float[Tensor, "9 p k 1"], points: Float[Tensor, "4 m p 1 lanes"], derivatives: bool = True
) -> tuple[list[Tensor], Float[Tensor, "m p k lanes"], Float[Tensor, "m p k lanes"]]:
    """The Sampson residual ``r = e / g`` and its Jacobian: g J (nine of them, then e), 1 / g^2, and r^2.

    ``e = x1^T F x0``, ``g^2`` the squared norm of the first two entries of ``F x0`` and ``F^T x1`` together (Hartley &
    Zisserman 2004, equation 11.9), so ``g dr = x1^T dF x0 - (e / g^2) ((F x0)^T D dF x0 + x1^T dF D F^T x1)`` with
    ``D = diag(1, 1, 0)``: the sum of two products of a column and a row.
    """
    x0, y0, x1, y1 = points
    a1 = torch.addcmul(torch.addcmul(f[2], f[0], x0), f[1], y0)
    b1 = torch.addcmul(torch.addcmul(f[5], f[3], x0), f[4], y0)
    c1 = torch.addcmul(torch.addcmul(f[8], f[6], x0), f[7], y0)
    a0 = torch.addcmul(torch.addcmul(f[6], f[0], x1), f[3], y1)
    b0 = torch.addcmul(torch.addcmul(f[7], f[1], x1), f[4], y1)
    e = torch.addcmul(torch.addcmul(c1, a1, x1), b1, y1)
    slope = torch.addcmul(torch.addcmul(torch.addcmul(a1 * a1, b1, b1), a0, a0), b0, b0)
    inverse = slope.clamp_min(TINY).reciprocal()
    c = e * inverse
    r2 = e * c
    if not derivatives:
        return [], inverse, r2
    u, v = torch.addcmul(x1, c, a1, value=-1), torch.addcmul(y1, c, b1, value=-1)  # x1 - c D F x0
    s, t = -c * a0, -c * b0  # -c D F^T x1
    rows = [
        torch.addcmul(u * x0, s, x1), torch.addcmul(u * y0, t, x1), u,
        torch.addcmul(v * x0, s, y1), torch.addcmul(v * y0, t, y1), v,
        s + x0, t + y0, torch.ones_like(e), e,
    ]  # fmt: skip
    return rows, inverse, r2


def solve(normal: Tensor, F: Tensor, e0: Tensor, e1: Tensor, damping: Tensor) -> Float[Tensor, "9 p k"]:
    """The damped Gauss-Newton step in the tangent space: ``(H + damping * mean curvature * I) step = -gradient``."""
    return -eliminate(*tangent_system(normal[:9, :9], F, e0, e1, damping), normal[:9, 9:])[:, 0]


def tangent_system(
    H: Float[Tensor, "9 9 p k"], F: Tensor, e0: Tensor, e1: Tensor, damping: Tensor
) -> tuple[Float[Tensor, "9 9 p k"], Float[Tensor, "9 p k"]]:
    """The damped normal matrix with the rank direction projected out, and that direction, ``e1 e0^T``.

    Along that direction and along F, to which the residual is blind, the matrix is given the mean curvature.
    """
    normal = (e1[:, None] * e0[None]).flatten(0, 1)
    mean = component_sum(torch.stack([H[i, i] for i in range(9)])) / 9
    h = component_sum(H * normal, 1)
    h = h - (component_sum(h * normal) - mean) / 2 * normal
    half = h[:, None] * normal
    H = H - (half + half.transpose(0, 1)) + 2 * mean * (normal[:, None] * normal) + (mean * F)[:, None] * F
    return H + (mean * damping) * torch.eye(9, dtype=H.dtype, device=H.device)[:, :, None, None], normal


def eliminate(H: Float[Tensor, "9 9 p k"], normal: Float[Tensor, "9 p k"], right: Float[Tensor, "9 r p k"]) -> Tensor:
    """Solve ``H x = right`` for positive definite H by Gauss-Jordan elimination, x orthogonal to `normal`."""
    right = right - normal[:, None] * component_sum(normal[:, None] * right)
    Q = torch.cat([H, right], 1)
    for i in range(9):
        pivot = Q[:, :1]
        row = Q[i, 1:] / pivot[i]
        Q = Q[:, 1:] - pivot * row
        Q[i] = row
    return Q


def retract(F: Tensor, step: Tensor, e0: Tensor, e1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The rank-2 matrix of unit norm ``F + step + alpha e1 e0^T``, and its epipoles."""
    G = F + step
    C = cofactors(G)
    determinant = component_sum(C[:3] * G[:3])
    normal = (e1[:, None] * e0[None]).flatten(0, 1)
    G = unit(G - determinant / component_sum(C * normal) * normal)
    C = cofactors(G).unflatten(0, (3, 3))  # a multiple of e1 e0^T
    return G, unit(component_sum(C * e1[:, None])), unit(component_sum(C * e0, 1))


def start(F: Float[Tensor, "9 p k"]) -> tuple[Tensor, Tensor, Tensor]:
    """A rank-2 matrix of unit norm close to F and its epipoles: ``F (I - e0 e0^T)``.

    e0 is the right singular vector of the smallest singular value, by five squarings of the matrix whose dominant
    eigenvector it is; to rounding where the last two singular values differ by half, and F has rank 2 in any case.
    """
    F = unit(F)
    C = cofactors(F).unflatten(0, (3, 3))
    K = component_sum(C[:, :, None] * C[:, None])  # C^T C
    for _ in range(5):
        K = unit((K / K.abs().amax((0, 1))).flatten(0, 1)).unflatten(0, (3, 3))
        K = component_sum(K[:, :, None] * K[:, None])
    size = component_sum(K * K, 1)
    column = size.argmax(0)
    e0 = unit(K.gather(0, column.expand(1, 3, *column.shape))[0])
    M = F.unflatten(0, (3, 3))
    G = unit((M - component_sum(M * e0, 1)[:, None] * e0).flatten(0, 1))
    return G, e0, unit(component_sum(cofactors(G).unflatten(0, (3, 3)) * e0, 1))


def cofactors(F: Float[Tensor, "9 *rest"]) -> Float[Tensor, "9 *rest"]:
    """The matrix of cofactors: ``det(F) F^-T`` where F is regular."""
    rows = F.unflatten(0, (3, 3))
    return torch.linalg.cross(rows[[1, 2, 0]], rows[[2, 0, 1]], dim=1).flatten(0, 1)


def unit(x: Float[Tensor, "c *rest"]) -> Float[Tensor, "c *rest"]:
    """Scaled to unit norm over the components; NaN where that is not possible."""
    return x / component_sum(x * x).sqrt()
