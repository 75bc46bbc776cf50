"""Non-linear refinement of fundamental matrices: Levenberg-Marquardt of the robust Sampson error.

Minimises ``sum_i w_i rho(r_i^2)``, r the Sampson distance, over the 7-dimensional manifold of 3 x 3 matrices of rank 2
and unit norm. The tangent space at F is what is orthogonal, in R^9, to F (scale) and to ``e1 e0^T`` (rank), with
``F e0 = 0`` and ``F^T e1 = 0`` the epipoles; a step is taken in it and brought back along ``e1 e0^T`` to determinant
zero, which is linear in that direction. This is the orthonormal parametrisation of Bartoli & Sturm (2004) to first
order, without its rotations, and without its defect where the singular values coincide.

Everything is element-wise or summed in a fixed order, so a model is refined to the same bits in any batch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.reduce import matmul3, stable_sum
from fmtorch.geometry.robust_kernels import Kernel, named_kernel

LANES = 64  # points are summed one by one into so many lanes, and these in a tree: part of the result's last bits
TILE_MODELS = 8  # models whose sums stay in the L2 cache together; changes no result
TILE_ELEMENTS = 1 << 13  # points times models of one step; changes no result
TINY = 1e-30  # squared slope of the epipolar constraint below which it is taken for this
DAMPING = 1e-4  # initial, relative to the mean curvature; divided or multiplied by 10 at each step
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-12, 1e6
RANK_TWO, RANK_TWO_EPIPOLE = (0.5**0.5, 0.0, 0.0, 0.0, 0.5**0.5, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
STEP_DAMPING = 1e-10  # of the attached step: bounds its gradient where the points leave a direction open


def refine_components(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    kernel: str,
    scale: Float[Tensor, " p"],
    iterations: int,
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"]]:
    """Refined models and their costs ``sum_i w_i rho(r_i^2)``, component by component, without gradients.

    F: k models for each of p pairs, entries row by row; made rank 2 first where they are not. points: x0, y0, x1, y1,
    of about unit scale; finite. weight: 0 in padded slots. scale: of the kernel, in the unit of the points.
    The cost of a model never rises above that of its (rank-2) start; a model that cannot be improved is kept, one that
    is not finite comes back as it was, with infinite cost.
    """
    with torch.no_grad():
        objective = Objective(points, weight, named_kernel(kernel), scale)
        state = _State(objective, *start(F), iterations > 0)
        damping = torch.full_like(state.cost, DAMPING)
        for i in range(iterations):
            step = solve(state.products, state.F, state.e0, state.e1, damping)
            trial = _State(objective, *retract(state.F, step, state.e0, state.e1), i + 1 < iterations)
            better = trial.cost < state.cost
            damping = torch.where(better, damping / 10, damping * 10).clamp_(SMALLEST_DAMPING, LARGEST_DAMPING)
            state.adopt(trial, better)
        kept = torch.isfinite(state.cost)
        return torch.where(kept, state.F, F), torch.where(kept, state.cost, torch.inf)


def refine(
    F: Float[Tensor, "*models 3 3"],
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
    *,
    kernel: str = "truncated",
    scale: float | Tensor = 1.0,
    iterations: int = 10,
) -> Float[Tensor, "*models 3 3"]:
    """The fundamental matrix of least robust Sampson error near F: ``sum_i w_i rho(r_i^2)``; without gradients.

    F: one matrix for each set of matches, or K of them, (*batch, K, 3, 3). weight: not negative, 1 by default.
    mask: False in slots to ignore, whatever they hold; a match that is not finite is ignored too.
    kernel: a name of `robust_kernels.KERNELS`. scale: of the kernel, in pixels (a number, or one per set).
    Returns matrices of rank 2 and unit norm in float64; one that cannot be refined comes back as it was, scaled.
    Raises ValueError for an unknown kernel. Bartoli & Sturm (2004); Hartley & Zisserman (2004), 11.4.3.
    """
    with torch.no_grad():
        problem = Normalised(x0, x1, weight, mask, F, scale)
        models, _ = refine_components(problem.models, problem.points, problem.weight, kernel, problem.scale, iterations)
        return problem.to_pixels(models).reshape(F.shape)


def attached_step(
    F: Float[Tensor, "*models 3 3"],
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
    *,
    kernel: str = "truncated",
    scale: float | Tensor = 1.0,
) -> Float[Tensor, "*models 3 3"]:
    """One Gauss-Newton step from a refined F, whose gradients are those of the optimum; arguments as of `refine`.

    The gradient of the cost is attached to the graph of points and weights, the normal matrix is not: the implicit
    function theorem, with the Hessian in Gauss and Newton's approximation: it has the kernel's curvature, but not that
    of the residuals, so it is exact where the residuals that count vanish. F itself gets no gradient. Where the points
    leave a direction open, the step and its gradients in it are damped; where F or the step is not finite, F comes
    back with gradients of zero.
    """
    problem = Normalised(x0, x1, weight, mask, F.detach(), scale)
    with torch.no_grad():
        model, e0, e1 = start(problem.models)
        robust = named_kernel(kernel)
        curved = robust._replace(weight=robust.curvature)  # Newton's weights of J^T J, not those of IRLS
        H = Objective(problem.points, problem.weight, curved, problem.scale)(model, True)[0][:9, :9]
        identity = torch.eye(9, dtype=H.dtype, device=H.device)[:, :, None, None].expand_as(H)
        inverse = constrained_solve(H, model, e0, e1, torch.full_like(H[0, 0], STEP_DAMPING), identity)
        sound = torch.isfinite(inverse).flatten(0, 1).all(0)
        inverse = torch.where(sound, inverse, 0)
        # Something of rank 2 instead of what is not finite: `where` alone would not keep NaN out of the gradients.
        model = torch.where(sound, model, _constant(model, RANK_TWO))
        e0, e1 = (torch.where(sound, e, _constant(e, RANK_TWO_EPIPOLE)) for e in (e0, e1))
    gradient = gradient_of_cost(model, problem.points, problem.weight, robust, problem.scale)
    step = -total((inverse * gradient).transpose(0, 1))
    moved, _, _ = retract(model, step, e0, e1)
    return problem.to_pixels(torch.where(sound, moved, problem.models)).reshape(F.shape)


def _constant(like: Tensor, components: tuple[float, ...]) -> Tensor:
    return like.new_tensor(components)[:, None, None]


def gradient_of_cost(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: Kernel,
    scale: Float[Tensor, " p"],
) -> Float[Tensor, "9 p k"]:
    """Half the gradient of the cost with respect to F, ``sum_i w_i rho'(r_i^2) r_i dr_i``; attached to all inputs."""
    rows, inverse, r2 = linearise(F[..., None].unbind(0), points[:, None, :, None])
    influence = weight[:, None] * robust.weight(r2, scale.square()[:, None, None]) * inverse * rows[9]
    return stable_sum(torch.stack(rows[:9]) * influence)[:, 0]


class Normalised:
    """Matches as `refine_components` wants them: live ones first, centred, of about unit scale; and models."""

    def __init__(
        self,
        x0: Tensor,
        x1: Tensor,
        weight: Tensor | None,
        mask: Tensor | None,
        F: Tensor,
        scale: float | Tensor,
    ) -> None:
        p, n = math.prod(x0.shape[:-2]), x0.shape[-2]
        x = torch.cat([x0, x1], -1).to(torch.float64).reshape(p, n, 4)
        w = torch.ones_like(x[..., 0]) if weight is None else weight.to(torch.float64).reshape(p, n)
        live = torch.isfinite(x).all(-1) & torch.isfinite(w)
        if mask is not None:
            live = live & mask.reshape(p, n)
        order = torch.argsort((~live).to(torch.uint8), dim=1, stable=True)
        live = live.gather(1, order)
        inside = live[..., None]
        x = torch.where(inside, x.gather(1, order[..., None].expand(-1, -1, 4)), 0)
        self.weight = torch.where(live, w.gather(1, order), 0)
        low = torch.where(inside, x.detach(), torch.inf).amin(1) if n else x.new_full((len(x), 4), torch.inf)
        high = torch.where(inside, x.detach(), -torch.inf).amax(1) if n else -low
        some = live.any(1)
        self.centre = torch.where(some[:, None], (low + high) / 2, 0)
        half = torch.where(some, ((high - low) / 2).amax(-1), 1)
        # A power of two, so that scaling rounds nothing; 1 where all points coincide.
        self.unit = torch.where(half > 0, torch.exp2(torch.ceil(torch.log2(half.clamp(1e-300, 1e300)))), 1)
        scaled = (x - self.centre[:, None]) / self.unit[:, None, None]
        self.points = torch.where(inside, scaled, 0).permute(2, 0, 1).contiguous()
        self.scale = torch.as_tensor(scale, dtype=torch.float64, device=x.device).expand(x0.shape[:-2]).reshape(p)
        self.scale = self.scale / self.unit
        A0, A1 = self._affinity(0), self._affinity(2)
        matrices = F.to(torch.float64).reshape(p, math.prod(F.shape[x0.dim() - 2 : -2]), 3, 3)
        self.models = _flat(matmul3(matmul3(A1.mT, matrices), A0))

    def to_pixels(self, models: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 3 3"]:
        """Matrices in pixels, of unit norm."""
        T0, T1 = self._similarity(0), self._similarity(2)
        F = matmul3(matmul3(T1.mT, matrices(models)), T0)
        return matrices(unit(_flat(F)))

    def _affinity(self, first: int) -> Float[Tensor, "p 1 3 3"]:
        """From normalised to pixel coordinates of one image."""
        A = torch.diag_embed(torch.stack([self.unit, self.unit, torch.ones_like(self.unit)], -1))
        A[:, :2, 2] = self.centre[:, first : first + 2]
        return A[:, None]

    def _similarity(self, first: int) -> Float[Tensor, "p 1 3 3"]:
        """From pixel to normalised coordinates of one image."""
        T = torch.diag_embed(torch.stack([1 / self.unit, 1 / self.unit, torch.ones_like(self.unit)], -1))
        T[:, :2, 2] = -self.centre[:, first : first + 2] / self.unit[:, None]
        return T[:, None]


def _flat(F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "9 p k"]:
    return F.flatten(2).permute(2, 0, 1).contiguous()


def matrices(F: Float[Tensor, "9 p k"]) -> Float[Tensor, "p k 3 3"]:
    """Components as matrices."""
    return F.permute(1, 2, 0).reshape(*F.shape[1:], 3, 3)


class _State:
    """A rank-2 model, its epipoles and cost, and the normal equations there."""

    def __init__(self, objective: Objective, F: Tensor, e0: Tensor, e1: Tensor, derivatives: bool) -> None:
        self.F, self.e0, self.e1 = F, e0, e1
        self.products, self.cost = objective(F, derivatives)

    def adopt(self, other: _State, condition: Tensor) -> None:
        """Become the other state where the condition holds (without its products if it has none)."""
        self.F = torch.where(condition, other.F, self.F)
        self.e0 = torch.where(condition, other.e0, self.e0)
        self.e1 = torch.where(condition, other.e1, self.e1)
        self.cost = torch.where(condition, other.cost, self.cost)
        if len(other.products):
            self.products = torch.where(condition, other.products, self.products)


def blocks(
    points: Float[Tensor, "4 p n"], weight: Float[Tensor, "p n"]
) -> tuple[Float[Tensor, "4 m p 1 lanes"], Float[Tensor, "m p 1 lanes"]]:
    """Points and weights cut into blocks of LANES, the last one padded with zeros of weight zero."""
    p, n = weight.shape
    m = max(1, -(-n // LANES))
    if n < m * LANES:
        points = torch.nn.functional.pad(points, (0, m * LANES - n))
        weight = torch.nn.functional.pad(weight, (0, m * LANES - n))
    points = points.reshape(4, p, m, 1, LANES).transpose(1, 2).contiguous()
    return points, weight.reshape(p, m, 1, LANES).transpose(0, 1).contiguous()


class Objective:
    """The robust cost of models of some pairs, with its normal equations, in tiles that stay in the cache."""

    def __init__(
        self,
        points: Float[Tensor, "4 p n"],
        weight: Float[Tensor, "p n"],
        robust: Kernel,
        scale: Float[Tensor, " p"],
    ) -> None:
        self.points, self.weight = blocks(points, weight)
        self.robust, self.s2 = robust, scale.square()[:, None, None]
        self.buffers: dict[tuple[int, ...], Tensor] = {}

    def __call__(
        self, F: Float[Tensor, "9 p k"], derivatives: bool
    ) -> tuple[Float[Tensor, "rows columns p k"], Float[Tensor, "p k"]]:
        """The weighted products of Jacobian and residual, [[J^T W J, J^T W r], [.., r^T W r]] (10, 10), and the cost.

        W holds the weights times those of the kernel. Without derivatives the first is empty.
        Each lane adds its points one after the other, so zeros at the end change nothing.
        """
        p, k = F.shape[1:]
        pairs = max(1, TILE_MODELS // k)
        if p <= pairs and k <= TILE_MODELS:
            return self._tile(F, slice(None), derivatives)
        rows = 10 if derivatives else 0
        products, cost = F.new_empty(rows, rows, p, k), F.new_empty(p, k)
        for i in range(0, p, pairs):
            some = slice(i, i + pairs)
            for j in range(0, k, TILE_MODELS):
                models = slice(j, j + TILE_MODELS)
                products[..., some, models], cost[some, models] = self._tile(F[:, some, models], some, derivatives)
        return products, cost

    def _tile(self, F: Tensor, pairs: slice, derivatives: bool) -> tuple[Tensor, Tensor]:
        points, weight, s2 = self.points[:, :, pairs], self.weight[:, pairs], self.s2[pairs]
        p, k = F.shape[1:]
        f = F[..., None].unbind(0)
        m, count = len(weight), max(1, TILE_ELEMENTS // (p * k * LANES))
        lanes: list[Tensor] = []
        sums = self._buffer(101, p, k, LANES)  # of the products, then the cost
        products = sums[:100].view(10, 10, p, k, LANES)
        for first in range(0, m, count):
            some = slice(first, first + count)
            w = weight[some]
            rows, inverse, r2 = linearise(f, points[:, some], derivatives)
            lanes += (self.robust.loss(r2, s2) * w).unbind(0)
            if not derivatives:
                continue
            A, B = self._buffer(2, len(w), 10, p, k, LANES).unbind(0)
            torch.stack(rows, 1, out=A)
            torch.mul(A, (self.robust.weight(r2, s2) * w * inverse)[:, None], out=B)
            for j, (a, b) in enumerate(zip(A[:, :, None].unbind(0), B[:, None].unbind(0), strict=True), start=first):
                if j == 0:
                    torch.mul(a, b, out=products)
                else:
                    products.addcmul_(a, b)
        cost = lanes[0]
        for lane in lanes[1:]:
            cost = cost + lane
        if not derivatives:
            return F.new_empty(0, 0, p, k), stable_sum(cost)
        sums[100] = cost
        half = LANES // 2  # the first level of the tree in place: memory newly mapped costs more than the sum
        sums = stable_sum(sums[..., :half].add_(sums[..., half:]))
        return sums[:100].view(10, 10, p, k), sums[100]

    def _buffer(self, *shape: int) -> Tensor:
        if shape not in self.buffers:
            self.buffers[shape] = self.points.new_empty(shape)
        return self.buffers[shape]


def linearise(
    f: Sequence[Float[Tensor, "p k 1"]], points: Float[Tensor, "4 m p 1 lanes"], derivatives: bool = True
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


def solve(
    products: Float[Tensor, "10 10 p k"], F: Tensor, e0: Tensor, e1: Tensor, damping: Tensor
) -> Float[Tensor, "9 p k"]:
    """The damped Gauss-Newton step in the tangent space: the least ``s^T (H + damping c I) s / 2 + s^T gradient``.

    c is the greatest diagonal entry of H.
    """
    return constrained_solve(products[:9, :9], F, e0, e1, damping, -products[:9, 9:])[:, 0]


def constrained_solve(
    H: Float[Tensor, "9 9 p k"], F: Tensor, e0: Tensor, e1: Tensor, damping: Tensor, right: Float[Tensor, "9 r p k"]
) -> Float[Tensor, "9 r p k"]:
    """Solve ``(H + damping c I) x = right`` for x orthogonal to ``e1 e0^T`` by Gauss-Jordan elimination.

    The constraint has a row and a column of its own; H is positive semidefinite, so that no pivoting is needed.
    Along F, to which the residual is blind, H is given the curvature c.
    """
    normal = (e1[:, None] * e0).flatten(0, 1)
    curvature = H.diagonal(dim1=0, dim2=1).amax(-1)
    Q = H.new_zeros(10, 10 + right.shape[1], *F.shape[1:])
    torch.add(H, (curvature * F)[:, None] * F, out=Q[:9, :9])
    Q[:9, :9].diagonal(dim1=0, dim2=1).add_((curvature * damping)[..., None])
    Q[:9, 9] = Q[9, :9] = normal
    Q[:9, 10:] = right
    for i in range(10):
        column, rest = Q.tensor_split((1,), 1)
        row = rest[i] / column[i]
        Q = torch.addcmul(rest, column, row, value=-1)
        Q[i] = row
    return Q[:9]


def retract(F: Tensor, step: Tensor, e0: Tensor, e1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The rank-2 matrix of unit norm ``F + step + alpha e1 e0^T``, and its epipoles."""
    G = F + step
    C = cofactors(G)
    determinant = total(C[:3] * G[:3])
    normal = (e1[:, None] * e0[None]).flatten(0, 1)
    G = unit(G - determinant / total(C * normal) * normal)
    C = square(cofactors(G))  # a multiple of e1 e0^T
    return G, unit(total(C * e1[:, None])), unit(total(C * e0, 1))


def start(F: Float[Tensor, "9 p k"]) -> tuple[Tensor, Tensor, Tensor]:
    """A rank-2 matrix of unit norm close to F and its epipoles: ``F (I - e0 e0^T)``.

    e0 is the right singular vector of the smallest singular value, by five squarings of the matrix whose dominant
    eigenvector it is; to rounding where the last two singular values differ by half, and F has rank 2 in any case.
    """
    F = unit(F)
    C = square(cofactors(F))
    K = total(C[:, :, None] * C[:, None])  # C^T C
    for _ in range(5):
        K = K / K.abs().amax((0, 1))
        K = total(K[:, :, None] * K[:, None])
    size = total(K * K, 1)
    column = size.argmax(0)
    e0 = unit(K.gather(0, column.expand(1, 3, *column.shape))[0])
    M = square(F)
    G = unit((M - total(M * e0, 1)[:, None] * e0).flatten(0, 1))
    return G, e0, unit(total(square(cofactors(G)) * e0, 1))


def cofactors(F: Float[Tensor, "9 p k"]) -> Float[Tensor, "9 p k"]:
    """The matrix of cofactors: ``det(F) F^-T`` where F is regular."""
    rows = square(F)
    crossed: Tensor = torch.linalg.cross(rows.roll(-1, 0), rows.roll(-2, 0), dim=1)
    return crossed.flatten(0, 1)


def square(F: Float[Tensor, "9 p k"]) -> Float[Tensor, "3 3 p k"]:
    """The components as rows and columns."""
    return F.reshape(3, 3, *F.shape[1:])


def total(x: Tensor, dim: int = 0) -> Tensor:
    """The sum over a short axis, in order: for few numbers this takes half as long as a tree."""
    first, *rest = x.unbind(dim)
    for part in rest:
        first = first + part
    return first


def unit(x: Float[Tensor, "c p k"]) -> Float[Tensor, "c p k"]:
    """Scaled to unit norm over the components; NaN where that is not possible."""
    norm: Tensor = total(x * x).sqrt()
    return x / norm
