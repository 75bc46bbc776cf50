"""Non-linear refinement of homographies: Levenberg-Marquardt of the robust Sampson error.

Minimises ``sum_i w_i rho(r_i^2)`` over the sphere of the nine entries, by kernels, and attaches the optimum to the
graph of points and weights. A model is refined to the same bits in any batch.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, stable_sum
from fmtorch.geometry.fixed_point import gradient_wanted
from fmtorch.geometry.homography_error import homography_curvature, homography_gradient
from fmtorch.geometry.homography_objective_kernels import refine_homographies
from fmtorch.geometry.levenberg_marquardt_kernels import FIRST_DAMPING, Schedule
from fmtorch.geometry.normalized_matches import NormalizedMatches, fitted_by
from fmtorch.geometry.optimum import inverse_hessian
from fmtorch.geometry.robust_losses import Kernel, named_kernel


def refine_homography(
    H: Float[Tensor, "*models 3 3"],
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
    *,
    kernel: str = "truncated",
    scale: float | Tensor = 1.0,
    iterations: int = 10,
) -> Float[Tensor, "*models 3 3"]:
    """The homography of least robust Sampson error near H: ``sum_i w_i rho(r_i^2)``.

    Hartley & Zisserman (2004), 4.5 and 4.2.6. Differentiable in points and weights by the implicit function theorem
    with the exact Hessian; there is no gradient to H. Gradients are bounded where the matches leave H open, and zero
    for a model that cannot be refined. The values are the same whether or not anything requires gradients; they are
    computed on the CPU.

    Args:
        H: one matrix for each set of matches, or K of them, (*batch, K, 3, 3), of any scale and sign.
        x0: points of image 0, pixels.
        x1: their matches in image 1.
        weight: not negative, 1 by default.
        mask: False in slots to ignore, whatever they hold; a match that is not finite is ignored too.
        kernel: a name of `robust_losses.KERNELS`.
        scale: of the kernel, in pixels (a number, or one per set).
        iterations: Levenberg-Marquardt steps.

    Returns:
        Matrices of unit norm in float64, whose third coordinate of H x0 is positive at most of the weight; one that
        cannot be refined comes back as it was, scaled.

    Raises:
        ValueError: for an unknown kernel.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import homography_points, refine_homography
        >>> H = torch.tensor([[1.0, 0.1, 5.0], [0.0, 0.9, 3.0], [1e-4, 0.0, 1.0]], dtype=torch.float64)
        >>> x0 = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 500
        >>> refined = refine_homography(torch.eye(3), x0, homography_points(H, x0), scale=500.0)
        >>> bool(((refined / refined[2, 2] - H).abs() < 1e-6).all())
        True
    """
    robust, schedule = named_kernel(kernel), Schedule(iterations, FIRST_DAMPING, 0.0)
    wanted = gradient_wanted(x0, x1, weight)
    with torch.set_grad_enabled(wanted):
        matches = NormalizedMatches(x0, x1, weight, mask, H.detach(), scale, homographies=True)
        shared, s2 = (matches.points, matches.weight), matches.scale.square()[:, None]
        models, _ = fitted_by(
            lambda models, data, out, cost: refine_homographies(models, data, schedule, out, cost),
            _seen_from_the_front(matches), *shared, s2, kernel,
        )  # fmt: skip
        if wanted:
            models = homography_at_optimum(models, *shared, robust, s2)
        return matches.to_pixels(models).reshape(H.shape)


def homography_at_optimum(
    H: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: Kernel,
    s2: Float[Tensor, "p slots"],
) -> Float[Tensor, "9 p k"]:
    """H, optima of unit norm on no graph, attached to the graph of points and weights by the implicit function theorem.

    s2: squared scales of the loss, one a pair or a match. As `optimum.at_optimum`: the optimum moves by minus the
    inverse Hessian, across H, times the change of the gradient.
    """
    valid = torch.isfinite(H).all(0) & (H != 0).any(0)
    model = torch.where(valid, H, torch.eye(3, dtype=H.dtype, device=H.device).reshape(9, 1, 1) / 3**0.5)
    inverse = inverse_hessian_of_homography(model, points.detach(), weight.detach(), robust, s2.detach())
    gradient = homography_gradient(model, points, weight, robust, s2)
    moved = component_sum(inverse * (gradient - gradient.detach()), 1)
    return H - torch.where(valid, moved, 0)


def inverse_hessian_of_homography(
    H: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: Kernel,
    s2: Float[Tensor, "p slots"],
) -> Float[Tensor, "9 9 p k"]:
    """That of half the cost at optima of unit norm, across these; arguments as of `homography_at_optimum`."""
    exact = _hessian(H, points, weight, robust, s2)
    gauss_newton = homography_curvature(H, points, weight, robust, s2)
    return inverse_hessian(exact, gauss_newton, H.movedim(0, -1)[..., None])


def _hessian(H: Tensor, points: Tensor, weight: Tensor, robust: Kernel, s2: Tensor) -> Float[Tensor, "p k 9 9"]:
    """Half the second derivative of the cost."""
    with torch.enable_grad():
        model = H.detach().clone().requires_grad_()
        gradient = homography_gradient(model, points, weight, robust, s2)
        rows = [torch.autograd.grad(gradient[i].sum(), model, retain_graph=True)[0] for i in range(9)]
    second = torch.stack(rows).movedim((0, 1), (-2, -1))
    return (second + second.mT) / 2


def _seen_from_the_front(matches: NormalizedMatches) -> Float[Tensor, "9 p k"]:
    """The models with a sign that makes the third coordinate positive at most of the matches' weight."""
    H, weight = matches.models.detach(), matches.weight.detach()[:, None]
    x, y, _, _ = matches.points.detach()[:, :, None]
    depth = H[6, ..., None] * x + H[7, ..., None] * y + H[8, ..., None]
    side = stable_sum(torch.where(depth > 0, weight, -weight))
    return torch.where(side < 0, -H, H)
