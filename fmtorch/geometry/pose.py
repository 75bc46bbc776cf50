"""The relative pose of two calibrated cameras from their fundamental matrix."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors, component_sum, cross, product, sqrt
from fmtorch.geometry.rank2 import complement, last_right_singular_vector


class Pose(NamedTuple):
    """X1 = R X0 + t with t a unit vector; how many points lie in front of both cameras; False where there is no pose.

    Where `valid` is False, R is the identity and t is zero.
    """

    R: Float[Tensor, "*batch 3 3"]
    t: Float[Tensor, "*batch 3"]
    n_in_front: Int[Tensor, "*batch"]
    valid: Bool[Tensor, "*batch"]


class FourPoses(NamedTuple):
    """The four motions X1 = R X0 + t, t of unit length, that an essential matrix has; False where it has none.

    Where `valid` is False, R is the identity and t is zero.
    """

    R: Float[Tensor, "*batch 4 3 3"]
    t: Float[Tensor, "*batch 4 3"]
    valid: Bool[Tensor, "*batch"]


class _Decomposition(NamedTuple):
    """R (3, 3, 4, *batch), t (3, 4, *batch), the inverse calibrations, and where all of them are determined."""

    R: Tensor
    t: Tensor
    inverses: tuple[Tensor, Tensor]
    valid: Tensor


def poses_from_fundamental(
    F: Float[Tensor, "*batch 3 3"], K0: Float[Tensor, "*batch 3 3"], K1: Float[Tensor, "*batch 3 3"]
) -> FourPoses:
    """The four decompositions of E = K1^T F K0, in no order of merit; matches tell which one is right.

    Hartley and Zisserman, Multiple View Geometry, 9.6.2. Float64 inside, F's type outside; differentiable.

    Args:
        F: fundamental matrices (..., 3, 3), of any scale and sign.
        K0: calibration matrices (..., 3, 3) of image 0.
        K1: those of image 1.

    Returns:
        `FourPoses`.
    """
    R, t, _, valid = _decomposed(F, K0, K1)
    R, t = R.movedim((2, 0, 1), (-3, -2, -1)), t.movedim((1, 0), (-2, -1))
    R = torch.where(valid[..., None, None, None], R, torch.eye(3, dtype=R.dtype, device=R.device))
    t = torch.where(valid[..., None, None], t, 0.0)
    return FourPoses(R.to(F.dtype), t.to(F.dtype), valid)


def pose_from_fundamental(
    F: Float[Tensor, "*batch 3 3"],
    K0: Float[Tensor, "*batch 3 3"],
    K1: Float[Tensor, "*batch 3 3"],
    x0: Float[Tensor, "*batch n 2"],
    x1: Float[Tensor, "*batch n 2"],
    mask: Bool[Tensor, "*batch n"] | None = None,
    weight: Float[Tensor, "*batch n"] | None = None,
) -> Pose:
    """Rotation and direction of translation from E = K1^T F K0, of the four decompositions the one with most points
    of positive depth in both cameras.

    Points in pixels. Hartley and Zisserman, Multiple View Geometry, 9.6.2, without an SVD: E is brought to the nearest
    essential matrix (singular values 1, 1, 0), and then R = cof(E) -+ [t]x E (Horn, Recovering Baseline and
    Orientation from Essential Matrix, 1990). Float64 inside, F's type outside; differentiable in F, K0 and K1.
    Invalid: F or a calibration not finite or singular where it must not be, or no point in front of both cameras.

    Args:
        F: fundamental matrices (..., 3, 3), of any scale and sign.
        K0: calibration matrices (..., 3, 3) of image 0.
        K1: those of image 1.
        x0: points in image 0, (..., N, 2), px.
        x1: their matches in image 1, (..., N, 2), px.
        mask: (..., N), True for the matches that decide; all by default.
        weight: (..., N), in [0, 1], by which matches count in that decision; all alike by default.

    Returns:
        A `Pose`.
    """
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    R, t, (inverse0, inverse1), regular = _decomposed(F, K0, K1)
    keep = mask & (x0.isfinite() & x1.isfinite()).all(-1)
    with torch.no_grad():
        ray0, ray1 = (_rays(K, torch.where(keep[..., None], x, 0.0)) for K, x in ((inverse0, x0), (inverse1, x1)))
        front = _in_front(R, t, ray0, ray1) & keep
        count = front.sum(-1)  # (4, *batch)
        best = (count if weight is None else _support(front, weight)).argmax(0)
    n_in_front = torch.gather(count, 0, best[None])[0]
    valid = regular & (n_in_front > 0)
    R = torch.gather(R, 2, best[None, None, None].expand(3, 3, 1, *best.shape))[:, :, 0].movedim((0, 1), (-2, -1))
    t = torch.gather(t, 1, best[None, None].expand(3, 1, *best.shape))[:, 0].movedim(0, -1)
    R = torch.where(valid[..., None, None], R, torch.eye(3, dtype=R.dtype, device=R.device))
    t = torch.where(valid[..., None], t, 0.0)
    return Pose(R.to(F.dtype), t.to(F.dtype), torch.where(valid, n_in_front, 0), valid)


def _decomposed(F: Tensor, K0: Tensor, K1: Tensor) -> _Decomposition:
    """The four motions of E = K1^T F K0, in float64."""
    F_, K0_, K1_ = (A.to(torch.float64).movedim((-2, -1), (0, 1)) for A in (F, K0, K1))
    finite = torch.stack([A.isfinite().all(0).all(0) for A in (F_, K0_, K1_)]).all(0)
    F_, K0_, K1_ = (torch.where(finite, A, 0.0) for A in (F_, K0_, K1_))
    E = product(product(K1_.transpose(0, 1), F_), K0_)
    inverse0, regular0 = _inverse(K0_)
    inverse1, regular1 = _inverse(K1_)
    E, t, two = _essential(E)
    straight, turned = cofactors(E), _cross_matrix_product(t, E)
    R = torch.stack([straight - turned, straight + turned, straight - turned, straight + turned], 2)
    t = torch.stack([t, t, -t, -t], 1)
    return _Decomposition(R, t, (inverse0, inverse1), finite & regular0 & regular1 & two)


def _essential(E: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest matrix with singular values (1, 1, 0) up to scale, its left null vector t, and whether E has rank 2.

    Between the planes across the null vectors E is a 2 x 2 matrix, whose nearest rotation or reflection is closed form.
    """
    size = E.detach().abs().amax((0, 1))
    E = E / torch.where(size > 0, size, 1.0)
    v, u = last_right_singular_vector(E), last_right_singular_vector(E.transpose(0, 1))
    p0, p1 = complement(u)
    q0, q1 = complement(v)
    Eq0, Eq1 = component_sum(E * q0, 1), component_sum(E * q1, 1)
    a, b, c, d = (component_sum(p * Eq) for p, Eq in ((p0, Eq0), (p0, Eq1), (p1, Eq0), (p1, Eq1)))
    determinant = a * d - b * c
    sign = torch.where(determinant.detach() < 0, -1.0, 1.0).to(E.dtype)
    cosine, sine = a + sign * d, c - sign * b
    norm2 = cosine * cosine + sine * sine  # the square of s1 + s2
    two = (determinant.detach().abs() > 1e-10 * norm2.detach()) & (norm2.detach() > 0)
    norm = sqrt(torch.where(two, norm2, 1.0))
    cosine, sine = torch.where(two, cosine, 1.0) / norm, torch.where(two, sine, 0.0) / norm
    left0, left1 = cosine * p0 + sine * p1, sign * (cosine * p1 - sine * p0)
    return left0[:, None] * q0 + left1[:, None] * q1, u, two


def _in_front(R: Tensor, t: Tensor, ray0: Tensor, ray1: Tensor) -> Tensor:
    """Which points have positive depth in both cameras, by least squares on d1 ray1 = d0 R ray0 + t: (4, *batch, n)."""
    rotated = component_sum(R[..., None] * ray0[None, :, None], 1)
    shift = t[..., None].expand_as(rotated)
    ray1 = ray1[:, None].expand_as(rotated)
    normal = cross(rotated, ray1)
    depth0 = component_sum(normal * cross(ray1, shift))
    depth1 = component_sum(normal * cross(rotated, shift))
    return (depth0 > 0) & (depth1 > 0)


def _support(front: Tensor, weight: Tensor) -> Tensor:
    """The sum of the weights of points in front, (4, *batch), as whole numbers: the same in any order."""
    rounded = (torch.where(front.any(0), weight.detach(), 0.0).clamp(0, 1).double() * 2.0**20).round().to(torch.int64)
    return torch.where(front, rounded, 0).sum(-1)


def _rays(inverse: Tensor, x: Tensor) -> Tensor:
    """K^-1 (x, y, 1): (3, *batch, n)."""
    x = x.to(torch.float64)
    columns = inverse[..., None]
    return columns[:, 0] * x[..., 0] + columns[:, 1] * x[..., 1] + columns[:, 2]


def _cross_matrix_product(t: Tensor, E: Tensor) -> Tensor:
    """[t]x E: the cross products of t with E's columns."""
    return torch.stack([cross(t, E[:, j]) for j in range(3)], 1)


def _inverse(K: Tensor) -> tuple[Tensor, Tensor]:
    """K^-1 by cofactors, and whether there is one."""
    C = cofactors(K)
    determinant = component_sum(K[0] * C[0])
    regular = determinant.detach() != 0
    return C.transpose(0, 1) / torch.where(regular, determinant, 1.0), regular
