"""Iteratively reweighted least squares for fundamental matrices."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.eight_point import linear_fundamental
from fmtorch.geometry.normalize import denormalize_fundamental, normalize_points
from fmtorch.geometry.rank2 import nearest_rank2
from fmtorch.geometry.refine import Normalised
from fmtorch.geometry.robust_kernels import Kernel, named_kernel
from fmtorch.geometry.sampson_objective import homogeneous, linearise


def irls(
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    F0: Float[Tensor, "*models 3 3"],
    weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
    *,
    kernel: str = "cauchy",
    scale: float | Tensor = 1.0,
    iterations: int = 5,
) -> Float[Tensor, "*models 3 3"]:
    """Fundamental matrices near F0 by the normalised 8-point algorithm with Sampson weights, repeated; no gradients.

    Each iteration weighs the squared algebraic error ``e^2`` of a match by ``w rho'(r^2) / g^2``, where ``r = e / g``
    is the Sampson distance under the last F: Torr & Murray (1997), "The development and comparison of robust methods
    for estimating the fundamental matrix", section 4. A fixed point is close to, but not quite, the least of
    ``sum w rho(r^2)``, since g moves with F: `refine` finds that.

    F0: one matrix for each set of matches, or K of them, (*batch, K, 3, 3). weight: not negative, 1 by default.
    mask: False in slots to ignore; matches that are not finite are ignored too. kernel: a name of
    `robust_kernels.KERNELS`. scale: of the kernel, in pixels (a number, or one per set). Returns matrices of rank 2 and
    unit norm in float64; a model that the weighted matches do not determine is kept as it was.
    Raises ValueError for an unknown kernel.
    """
    robust = named_kernel(kernel)
    with torch.no_grad():
        problem = Normalised(x0, x1, weight, mask, F0, scale)
        F = problem.models
        for _ in range(iterations):
            F = reweighted(F, problem.points, problem.weight, robust, problem.scale)
        return problem.to_pixels(F).reshape(F0.shape)


def reweighted(
    F: Float[Tensor, "9 p k"],
    points: Float[Tensor, "4 p n"],
    weight: Float[Tensor, "p n"],
    robust: Kernel,
    scale: Float[Tensor, " p"],
) -> Float[Tensor, "9 p k"]:
    """One iteration, component by component: the 8-point algorithm with the weights that the residuals under F give.

    F: k models for each of p pairs, entries row by row. points: x0, y0, x1, y1, of about unit scale; finite. weight: 0
    in padded slots. scale: of the kernel, in the unit of the points. Models of rank 2; one that the weighted matches do
    not determine is kept as it was.
    """
    p, k = F.shape[1:]
    _, _, inverse, r2 = linearise(F, homogeneous(points[:, None, :, None]), derivatives=False)
    w = weight[:, None] * (robust.weight(r2, scale.square()[:, None, None]) * inverse)[0]
    usable = torch.isfinite(w).all(-1, keepdim=True) & (w > 0).any(-1, keepdim=True)
    w = torch.where(usable, w / w.amax(-1, keepdim=True), 0)
    points = points[:, :, None].expand(4, p, k, -1).movedim(0, -1)
    x0, T0 = normalize_points(points[..., :2], weight=w)
    x1, T1 = normalize_points(points[..., 2:], weight=w)
    linear, determined = linear_fundamental(x0, x1, w)
    fitted = denormalize_fundamental(nearest_rank2(linear), T0, T1).flatten(2).movedim(-1, 0)
    sound = determined & usable[..., 0] & torch.isfinite(fitted).all(0) & (fitted != 0).any(0)
    return torch.where(sound, fitted, F)
