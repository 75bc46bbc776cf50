"""The covariance of estimates with cameras, as their fields."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.arithmetic import cofactors, component_sum, determinant, matmul3, sqrt
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.two_view_covariance import two_view_covariance


@torch.no_grad()
def covariance_fields(
    estimate: Estimate, c: Correspondences, maps: Float[Tensor, "b 2 3 3"] | None, focals: Float[Tensor, "b 2"]
) -> dict[str, Tensor]:
    """The fields `covariance`, `tangents`, `covariance_F` of an estimate with a pose; NaN where there is none.

    c: its matches, in images of square pixels and central principal points. maps: from the coordinates that F is of to
    those of c, None where these are the same. focals: of c.
    """
    R, t, scale = estimate.R, estimate.t, estimate.fit_scale
    if R is None or t is None or scale is None or c.size0 is None or c.size1 is None:
        shapes = {"covariance": (7, 7), "tangents": (3, 2), "covariance_F": (9, 9)}
        return {name: focals.new_full((len(c), *shape), torch.nan) for name, shape in shapes.items()}
    centre0, centre1 = ((size.to(focals).flip(-1) - 1) / 2 for size in (c.size0, c.size1))
    weight, precision = c.prior, estimate.focal_precision
    if weight is not None and precision is not None:  # as fits with exactly known focal lengths count it
        exact = precision.diagonal(dim1=-2, dim2=-1).isinf().all(1)[:, None]
        weight = torch.where(exact, sqrt(weight.double().clamp_min(0)), weight.double())
    computed = two_view_covariance(
        c.x0, c.x1, R, t, focals, centre0, centre1, scale, weight, c.noise, c.mask & estimate.ok[:, None],
        precision, c.shared_focal,
    )  # fmt: skip
    of_F = computed.fundamental
    if maps is not None:
        of_F = _mapped(of_F, estimate.F.to(focals), *maps.to(focals).unbind(1))
    fields = {"covariance": computed.covariance, "tangents": computed.tangent, "covariance_F": of_F}
    valid = (estimate.ok & computed.valid)[:, None, None]
    return {name: torch.where(valid, value, torch.nan) for name, value in fields.items()}


def _mapped(C: Float[Tensor, "b 9 9"], F: Float[Tensor, "b 3 3"], A0: Tensor, A1: Tensor) -> Float[Tensor, "b 9 9"]:
    """The covariance of F, which is A1^T G A0 at unit norm, from that of G at unit norm."""
    G = matmul3(matmul3(_inverse(A1).mT, F), _inverse(A0)).flatten(1)
    M = (A1.mT[:, :, None, :, None] * A0.mT[:, None, :, None, :]).flatten(3).flatten(1, 2)
    M = M / _inverse_norm(G)[:, None, None]
    f = F.flatten(1)
    J = M - f[:, :, None] * component_sum(f[:, :, None] * M, 1)[:, None]
    return _product(_product(J, C), J.mT)


def _inverse(A: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    components = A.movedim((-2, -1), (0, 1))
    return (cofactors(components) / determinant(components)).movedim((0, 1), (-1, -2))


def _product(A: Float[Tensor, "b k m"], B: Float[Tensor, "b m n"]) -> Float[Tensor, "b k n"]:
    """``A B``, the same bits in any batch."""
    return component_sum(A[..., None] * B[:, None], 2)


def _inverse_norm(x: Float[Tensor, "b m"]) -> Float[Tensor, " b"]:
    return inverse_root(component_sum(x * x, -1))
