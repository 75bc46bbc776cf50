"""Non-linear refinement of fundamental matrices: Levenberg-Marquardt of the robust Sampson error.

Minimises ``sum_i w_i rho(r_i^2)``, r the Sampson distance, over the 7-dimensional manifold of 3 x 3 matrices of rank 2
and unit norm (see `rank2_manifold`). A model is refined to the same bits in any batch (see `sampson_objective`).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.rank2_manifold import (
    RANK_TWO,
    RANK_TWO_EPIPOLE,
    SQUARINGS,
    constant,
    constrained_solve,
    retract,
    solve,
    start,
    unit,
)
from fmtorch.geometry.reduce import component_sum, matmul3, stable_sum
from fmtorch.geometry.robust_kernels import Kernel, named_kernel
from fmtorch.geometry.sampson_objective import Objective, homogeneous, linearise

DAMPING = 1e-4  # initial, relative to the mean curvature; divided or multiplied by 10 at each step
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-12, 1e6
RANK_TWO_ALREADY = 1  # squarings that suffice where the last singular value is but rounding of float32
STEP_DAMPING = 1e-10  # of the attached step: bounds its gradient where the points leave a direction open


def refine_components(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    kernel: str,
    scale: Float[Tensor, " p"] | Float[Tensor, "p slots"],
    iterations: int,
    tolerance: float = 0.0,
    squarings: int = SQUARINGS,
    damping: float = DAMPING,
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"]]:
    """Refined models and their costs ``sum_i w_i rho(r_i^2)``, component by component, without gradients.

    F: k models for each of p pairs, entries row by row; made rank 2 first where they are not. points: x0, y0, x1, y1,
    of about unit scale; finite. weight: 0 in padded slots. scale: of the kernel, in the unit of the points,
    one for all matches of a pair, (p,) or (p, 1), or one for each (p, n).
    iterations: at most. tolerance: a model is done once a step has lowered its cost by no more than this share of it.
    squarings: of `start`. damping: of the first step.
    The cost of a model never rises above that of its (rank-2) start; a model that cannot be improved is kept, one that
    is not finite comes back as it was, with infinite cost.
    """
    with torch.no_grad():
        objective = Objective(points, weight, named_kernel(kernel), scale)
        state = _State(objective, *start(F, squarings), iterations > 0)
        damped = torch.full_like(state.cost, damping)
        done = torch.zeros_like(state.cost, dtype=torch.bool)
        for i in range(iterations):
            step = solve(state.products, state.F, state.e0, state.e1, damped)
            trial = _State(objective, *retract(state.F, step, state.e0, state.e1), i + 1 < iterations)
            better = (trial.cost < state.cost) & ~done
            damped = torch.where(better, damped / 10, damped * 10).clamp_(SMALLEST_DAMPING, LARGEST_DAMPING)
            if tolerance:
                done |= better & (state.cost - trial.cost <= tolerance * state.cost)
            state.adopt(trial, better)
            if tolerance and bool(done.all()):
                break
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
        model = torch.where(sound, model, constant(model, RANK_TWO))
        e0, e1 = (torch.where(sound, e, constant(e, RANK_TWO_EPIPOLE)) for e in (e0, e1))
    gradient = gradient_of_cost(model, problem.points, problem.weight, robust, problem.scale)
    step = -component_sum((inverse * gradient).transpose(0, 1))
    moved, _, _ = retract(model, step, e0, e1)
    return problem.to_pixels(torch.where(sound, moved, problem.models)).reshape(F.shape)


def gradient_of_cost(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: Kernel,
    scale: Float[Tensor, " p"],
) -> Float[Tensor, "9 p k"]:
    """Half the gradient of the cost with respect to F, ``sum_i w_i rho'(r_i^2) r_i dr_i``; attached to all inputs."""
    J, e, inverse, r2 = linearise(F, homogeneous(points[:, None, :, None]))
    influence = weight[:, None] * robust.weight(r2, scale.square()[:, None, None]) * inverse * e
    return stable_sum(J.flatten(0, 1) * influence)[:, 0]


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
        self.counts = live.reshape(x0.shape[:-1])
        self._order = order = torch.argsort((~live).to(torch.uint8), dim=1, stable=True)
        self._live = live = live.gather(1, order)
        inside = live[..., None]
        x = torch.where(inside, x.gather(1, order[..., None].expand(-1, -1, 4)), 0)
        self.weight = self.ordered(w)
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
        # What is no model gets no gradient.
        F = torch.where(
            (torch.isfinite(F) & (F != 0).any(-1, True).any(-2, True)).all(-1, True).all(-2, True), F, F.detach()
        )
        matrices = F.to(torch.float64).reshape(p, math.prod(F.shape[x0.dim() - 2 : -2]), 3, 3)
        self.models = _flat(_about_unit(matmul3(matmul3(A1.mT, matrices), A0)))

    def ordered(self, weight: Float[Tensor, "*batch n"]) -> Float[Tensor, "p n"]:
        """Values of matches in the caller's order in the order of `points`, 0 in padded slots; float64."""
        flat = weight.to(torch.float64).reshape(self._order.shape)
        return torch.where(self._live, flat.gather(1, self._order), 0)

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


def _about_unit(F: Float[Tensor, "p k 3 3"]) -> Float[Tensor, "p k 3 3"]:
    """Matrices scaled by a power of two, which rounds nothing, so that no square under- or overflows."""
    largest = F.detach().abs().amax((-2, -1), keepdim=True)
    usual = (largest > 1e-300) & (largest < 1e300)
    return F / torch.exp2(torch.floor(torch.log2(torch.where(usual, largest, 1))))


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
