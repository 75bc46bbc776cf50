"""Gradients of the fixed point of an iteration over fundamental matrices, by the implicit function theorem."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, unit
from fmtorch.geometry.rank2_manifold import RANK_TWO, constant

CONTRACTION_GAP = 1e-6  # singular values of I - J below it, of an iteration that does not contract, are held off zero


def gradient_wanted(*inputs: object) -> bool:
    """Whether a graph is being recorded and one of the inputs is on it."""
    return torch.is_grad_enabled() and any(isinstance(x, Tensor) and x.requires_grad for x in inputs)


def at_fixed_point(F: Float[Tensor, "9 p k"], step: Callable[[Tensor], Tensor]) -> Float[Tensor, "9 p k"]:
    """F, a fixed point of `step` up to scale and sign, attached to the graph of everything else that `step` reads.

    With G(F, theta) the step, scaled to unit norm, and J its Jacobian with respect to F, the fixed point moves by
    ``dF = (I - J)^-1 dG/dtheta dtheta`` (Bai et al., NeurIPS 2019, theorem 1). G maps to the manifold of rank 2 and
    unit norm, so J and dG map to its 7-dimensional tangent space, and dF lies in it. Where the iteration does not
    contract, singular values s of I - J are inverted as ``s / (s^2 + CONTRACTION_GAP^2)``, which bounds the gradient.

    Args:
        F: k models for each of p pairs, entries row by row, on no graph; of rank 2. One that is zero or not finite has
            a gradient of zero.
        step: one iteration of all models, each for itself; a model that it leaves as it is has a gradient of zero.

    Returns:
        The same values.
    """
    valid = torch.isfinite(F).all(0) & (F != 0).any(0)
    fixed = unit(torch.where(valid, F, constant(F, RANK_TWO)))

    def mapped(start: Tensor) -> Tensor:
        G = unit(step(start))
        along = component_sum(G.detach() * fixed)
        return torch.where(along < 0, -G, G)

    with torch.enable_grad():
        start = fixed.detach().clone().requires_grad_()
        end = mapped(start)
        rows = [torch.autograd.grad(end[i].sum(), start, retain_graph=True)[0] for i in range(9)]
        attached = mapped(fixed)
    J = torch.stack(rows).movedim((0, 1), (-2, -1))
    known = valid & torch.isfinite(J).flatten(-2).all(-1)
    difference = torch.eye(9, dtype=J.dtype, device=J.device) - torch.where(known[..., None, None], J, 0.0)
    U, s, Vh = torch.linalg.svd(difference)
    inverse = (Vh.mT * (s / (s * s + CONTRACTION_GAP**2))[..., None, :]) @ U.mT
    inverse = torch.where(known[..., None, None], inverse, 0.0).movedim((-2, -1), (0, 1))
    size = torch.where(valid, component_sum(F * fixed), 0.0)
    moved = component_sum(inverse * (attached - attached.detach()), 1) * size
    return F + torch.where(valid, moved, 0.0)  # keeps the gradient of what is not finite out
