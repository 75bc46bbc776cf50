"""The covariance of estimates with cameras, as their fields."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.arithmetic import cofactors, component_sum, determinant, matmul3
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.two_view_covariance import two_view_covariance


@torch.no_grad()
def covariance_fields(
    estimate: Estimate, c: Correspondences, focals: Float[Tensor, "b 2"], maps: tuple[Tensor, Tensor]
) -> dict[str, Tensor]:
    """The fields `covariance`, `tangents`, `covariance_F` of an estimate with a pose; NaN where there is none.

    c: its matches, in images of square pixels and central principal points. focals: of these. maps: (B, 3, 3) each,
    from the coordinates that F is of to those of c.
    """
    assert estimate.R is not None
    assert estimate.t is not None
    assert estimate.fit_scale is not None
    centres = [torch.zeros_like(focals) if s is None else (s.flip(-1) - 1.0) / 2 for s in (c.size0, c.size1)]
    computed = two_view_covariance(
        c.x0, c.x1, estimate.R, estimate.t, focals, *centres, estimate.fit_scale, c.prior, c.noise,
        c.mask & estimate.ok[:, None], estimate.focal_precision, c.shared_focal,
    )  # fmt: skip
    valid = (estimate.ok & computed.valid)[:, None, None]
    fields = {
        "covariance": computed.covariance, "tangents": computed.tangent,
        "covariance_F": _mapped(computed.fundamental, estimate.F.to(focals), *maps),
    }  # fmt: skip
    return {name: torch.where(valid, value, torch.nan) for name, value in fields.items()}


def _mapped(C: Float[Tensor, "b 9 9"], F: Float[Tensor, "b 3 3"], A0: Tensor, A1: Tensor) -> Float[Tensor, "b 9 9"]:
    """The covariance of F, which is A1^T G A0 at unit norm, from that of G at unit norm."""
    G = matmul3(matmul3(_inverse(A1).mT, F), _inverse(A0)).flatten(1)
    M = (A1.mT[:, :, None, :, None] * A0.mT[:, None, :, None, :]).flatten(3).flatten(1, 2) / _inverse_norm(G)[
        :, None, None
    ]
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
