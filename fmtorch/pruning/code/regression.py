"""Robust ridge regression by iteratively reweighted least squares."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.geometry.robust_losses import huber_weight


def huber_regression(
    basis: Float[Tensor, "n m"],
    target: Float[Tensor, "n k"],
    ridge: Float[Tensor, "m m"],
    *,
    scale: float,
    iterations: int,
) -> Float[Tensor, "m k"]:
    """The coefficients C (m, k) that minimise ``sum_j huber(|target_j - basis_j C|) + tr(C^T ridge C)``.

    Huber's loss is quadratic up to `scale` and linear beyond; a row of the target counts by its length. Starts from
    C = 0. Each iteration weights the rows by their residuals and solves the normal equations, which are summed in the
    type of the basis and solved in float64 by Cholesky's decomposition; `ridge` (positive definite) keeps them regular.
    """
    coefficients = basis.new_zeros(basis.shape[1], target.shape[1])
    scale2 = basis.new_tensor(scale * scale)
    for _ in range(iterations):
        residual = target - basis @ coefficients
        weight = huber_weight(residual.square().sum(1), scale2)
        weighted = (basis * weight[:, None]).T
        normal = (weighted @ basis).double() + ridge.double()
        factor = torch.linalg.cholesky_ex(normal).L
        coefficients = torch.cholesky_solve((weighted @ target).double(), factor).to(basis.dtype)
    return coefficients
