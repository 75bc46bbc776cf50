"""The relative pose of two calibrated cameras from their fundamental matrix."""

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors, component_sum, cross, product, sqrt
from fmtorch.geometry.levenberg_marquardt import SQUARINGS
from fmtorch.geometry.matrices import complement, complement_kernel, last_right_singular_vector
from fmtorch.geometry.normalize import Mask, Matrices, PerMatch, Points
from fmtorch.geometry.rank2_manifold import start_one
from fmtorch.jit.kernel import Array, F8x1, F8x2, inner, kernel, matrix, vector
from fmtorch.jit.lanes import fill, load


class Pose(NamedTuple):
    """X1 = R X0 + t with t a unit vector; how many points lie in front of both cameras; False where there is no pose.
    Where `valid` is False, R is the identity and t is zero."""

    R: Matrices
    t: Float[Tensor, "*batch 3"]
    n_in_front: Int[Tensor, "*batch"]
    valid: Bool[Tensor, "*batch"]


class FourPoses(NamedTuple):
    """The four motions X1 = R X0 + t, t of unit length, that an essential matrix has; False where it has none.
    Where `valid` is False, R is the identity and t is zero."""

    R: Float[Tensor, "*batch 4 3 3"]
    t: Float[Tensor, "*batch 4 3"]
    valid: Bool[Tensor, "*batch"]


def poses_from_fundamental(F: Matrices, K0: Matrices, K1: Matrices) -> FourPoses:
    """The four decompositions of E = K1^T F K0, in no order of merit; matches tell which one is right.
    Hartley and Zisserman, 9.6.2. Float64 inside, F's type outside; differentiable. K: as of `pose_from_fundamental`."""
    R, t, _, valid = _decomposed(F, K0, K1)
    R, t = R.movedim((2, 0, 1), (-3, -2, -1)), t.movedim((1, 0), (-2, -1))
    R = torch.where(valid[..., None, None, None], R, torch.eye(3, dtype=R.dtype, device=R.device))
    t = torch.where(valid[..., None, None], t, 0.0)
    return FourPoses(R.to(F.dtype), t.to(F.dtype), valid)


def pose_from_fundamental(
    F: Matrices, K0: Matrices, K1: Matrices, x0: Points, x1: Points, mask: Mask | None = None,
    weight: PerMatch | None = None, behind: Bool[Tensor, "*batch n 2"] | None = None,
) -> Pose:  # fmt: skip
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
        behind: (..., N, 2), which points stand for what a lens sees behind camera 0, or 1; none by default.

    Returns:
        A `Pose`.
    """
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    R, t, (inverse0, inverse1), regular = _decomposed(F, K0, K1)
    keep = mask & (x0.isfinite() & x1.isfinite()).all(-1)
    with torch.no_grad():
        ray0, ray1 = (rays(K, torch.where(keep[..., None], x, 0.0)) for K, x in ((inverse0, x0), (inverse1, x1)))
        if behind is not None:
            ray0, ray1 = (torch.where(behind[..., k], -ray, ray) for k, ray in enumerate((ray0, ray1)))
        front = _in_front(R, t, ray0, ray1) & keep
        count = support = front.sum(-1)  # (4, *batch)
        if weight is not None:  # whole numbers, whose sums are the same in any order
            counted = torch.where(front.any(0), weight.detach(), 0.0).clamp(0, 1).double()
            support = torch.where(front, (counted * 2.0**20).round().to(torch.int64), 0).sum(-1)
        best = support.argmax(0)
    n_in_front = torch.gather(count, 0, best[None])[0]
    valid = regular & (n_in_front > 0)
    R = torch.gather(R, 2, best[None, None, None].expand(3, 3, 1, *best.shape))[:, :, 0].movedim((0, 1), (-2, -1))
    t = torch.gather(t, 1, best[None, None].expand(3, 1, *best.shape))[:, 0].movedim(0, -1)
    R = torch.where(valid[..., None, None], R, torch.eye(3, dtype=R.dtype, device=R.device))
    t = torch.where(valid[..., None], t, 0.0)
    return Pose(R.to(F.dtype), t.to(F.dtype), torch.where(valid, n_in_front, 0), valid)


def _decomposed(F: Tensor, K0: Tensor, K1: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor], Tensor]:
    """The four motions of E = K1^T F K0: R (3, 3, 4, *batch), t (3, 4, *batch), float64; the inverse calibrations; and
    where all of them are determined."""
    F_, K0_, K1_ = (A.to(torch.float64).movedim((-2, -1), (0, 1)) for A in (F, K0, K1))
    finite = torch.stack([A.isfinite().all(0).all(0) for A in (F_, K0_, K1_)]).all(0)
    F_, K0_, K1_ = (torch.where(finite, A, 0.0) for A in (F_, K0_, K1_))
    E = product(product(K1_.transpose(0, 1), F_), K0_)
    inverse0, regular0 = inverse(K0_)
    inverse1, regular1 = inverse(K1_)
    E, t, two = _essential(E)
    straight, turned = cofactors(E), torch.stack([cross(t, E[:, j]) for j in range(3)], 1)
    R = torch.stack([straight - turned, straight + turned, straight - turned, straight + turned], 2)
    t = torch.stack([t, t, -t, -t], 1)
    return R, t, (inverse0, inverse1), finite & regular0 & regular1 & two


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


def rays(inverse: Tensor, x: Tensor) -> Tensor:
    """K^-1 (x, y, 1): (3, *batch, n)."""
    x = x.to(torch.float64)
    columns = inverse[..., None]
    return columns[:, 0] * x[..., 0] + columns[:, 1] * x[..., 1] + columns[:, 2]


def calibrated(x: Array, K: Array) -> Array:
    """K^-1 (x, y, 1) of pixels (n, 2) of one image, without the ones: (n, 2)."""
    return rays(inverse(torch.from_numpy(K))[0], torch.from_numpy(x))[:2].T.contiguous().numpy()


def inverse(K: Tensor) -> tuple[Tensor, Tensor]:
    """K^-1 by cofactors, and whether there is one."""
    C = cofactors(K)
    determinant = component_sum(K[0] * C[0])
    regular = determinant.detach() != 0
    return C.transpose(0, 1) / torch.where(regular, determinant, 1.0), regular


# `pose` for one pair of cameras with square pixels, compiled; and the essential matrix nearest to a model

WEIGHT_BITS = 20  # fractional, of weights, so that their sums are exact
RANK_2 = 1e-10  # share of the squared norm that the product of the singular values must exceed


@inner
def nearest_axes(M: Array, e0: Array, e1: Array, U: Array, V: Array) -> Any:
    """U and V (3, 3) of the essential matrix nearest to M (9,), whose epipoles are e0, e1; whether M has rank 2.
    In the planes across the epipoles M is 2 x 2; its nearest orthogonal matrix gives both singular values 1."""
    p, q, a, b = vector(3), vector(3), vector(3), vector(3)
    complement_kernel(e0, p, q)
    complement_kernel(e1, a, b)
    m00, m01, m10, m11 = 0.0, 0.0, 0.0, 0.0
    for r in range(3):
        Mp = M[3 * r] * p[0] + M[3 * r + 1] * p[1] + M[3 * r + 2] * p[2]
        Mq = M[3 * r] * q[0] + M[3 * r + 1] * q[1] + M[3 * r + 2] * q[2]
        m00, m01, m10, m11 = m00 + a[r] * Mp, m01 + a[r] * Mq, m10 + b[r] * Mp, m11 + b[r] * Mq
    sign = 1.0 if m00 * m11 >= m01 * m10 else -1.0
    cosine, sine = m00 + sign * m11, m10 - sign * m01
    norm = math.sqrt(cosine * cosine + sine * sine)
    cosine, sine = cosine / norm, sine / norm
    for r in range(3):
        U[r, 0], U[r, 1] = a[r] * cosine + b[r] * sine, sign * (b[r] * cosine - a[r] * sine)
        V[r, 0], V[r, 1] = p[r], q[r]
        U[r, 2], V[r, 2] = e1[r], e0[r]
    return abs(m00 * m11 - m01 * m10) > RANK_2 * norm * norm


@kernel(holds_gil=True)
def pose(F: F8x2, cameras: F8x1, x0: F8x2, x1: F8x2, weight: F8x1, out: F8x1) -> None:
    """The pose of a fundamental matrix (3, 3), of four the one with the most support in front -> out (13,).
    cameras: (6,), focal length and principal point of both. x0, x1: (n, 2). weight: (n,), in [0, 1], by which matches
    count. out: R row by row, t of unit length, and 1; all zero where there is no pose."""
    M, G, e0, e1, U, V, R = vector(9), vector(9), vector(3), vector(3), matrix(3, 3), matrix(3, 3), matrix(6, 3)
    f0, u0, v0, f1, u1, v1 = cameras
    for r in range(3):  # E = K1^T F K0
        G[3 * r], G[3 * r + 1] = F[r, 0] * f0, F[r, 1] * f0
        G[3 * r + 2] = F[r, 0] * u0 + F[r, 1] * v0 + F[r, 2]
    for c in range(3):
        M[c], M[3 + c] = G[c] * f1, G[3 + c] * f1
        M[6 + c] = G[c] * u1 + G[3 + c] * v1 + G[6 + c]
    start_one(M, SQUARINGS, G, e0, e1)
    valid = nearest_axes(G, e0, e1, U, V)
    handed = handedness(U) * handedness(V)
    for r in range(3):
        for c in range(3):
            turned, straight = U[r, 1] * V[c, 0] - U[r, 0] * V[c, 1], U[r, 2] * V[c, 2] * handed
            R[r, c], R[3 + r, c] = straight + turned, straight - turned
    support = vector(4)
    for i in range(4):
        support[i] = 0.0
    a, b = vector(3), vector(3)
    a[2] = b[2] = 1.0
    for i in range(len(weight)):
        if weight[i] > 0:
            a[0], a[1] = (x0[i, 0] - u0) / f0, (x0[i, 1] - v0) / f0
            b[0], b[1] = (x1[i, 0] - u1) / f1, (x1[i, 1] - v1) / f1
            _vote(R, U, a, b, math.floor(min(weight[i], 1.0) * 2.0**WEIGHT_BITS + 0.5), support)
    best = 0
    for i in range(1, 4):
        best = i if support[i] > support[best] else best
    for r in range(3):
        out[9 + r] = U[r, 2] if best < 2 else -U[r, 2]
        for c in range(3):
            out[3 * r + c] = R[3 * (best % 2) + r, c]
    finite = valid and support[best] > 0
    for i in range(12):
        finite = finite and math.isfinite(out[i])
    for i in range(12):
        out[i] = out[i] if finite else 0.0
    out[12] = 1.0 if finite else 0.0


@inner
def _vote(R: Array, U: Array, a: Array, b: Array, weight: float, support: Array) -> None:
    """Adds the weight of a match of rays a, b to the poses R[:3], R[3:], and these with -t, in front of which it lies.
    Least squares on d1 b = d0 R a + t: the signs of the depths are those of n (b x t) and n (R a x t), n = R a x b."""
    for k in range(2):
        p, q, r = 0.0, 0.0, 0.0
        for i in range(3):
            p += R[3 * k, i] * a[i]
            q += R[3 * k + 1, i] * a[i]
            r += R[3 * k + 2, i] * a[i]
        nx, ny, nz = q * b[2] - r * b[1], r * b[0] - p * b[2], p * b[1] - q * b[0]
        tx, ty, tz = U[0, 2], U[1, 2], U[2, 2]
        depth0 = nx * (b[1] * tz - b[2] * ty) + ny * (b[2] * tx - b[0] * tz) + nz * (b[0] * ty - b[1] * tx)
        depth1 = nx * (q * tz - r * ty) + ny * (r * tx - p * tz) + nz * (p * ty - q * tx)
        if depth0 > 0 and depth1 > 0:
            support[k] += weight
        if depth0 < 0 and depth1 < 0:
            support[2 + k] += weight


@inner
def handedness(M: Array) -> Any:
    """The sign of the determinant (3, 3) of orthogonal columns."""
    a = M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
    b = M[0, 1] * (M[1, 2] * M[2, 0] - M[1, 0] * M[2, 2]) + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    return 1.0 if a + b > 0 else -1.0


# The oriented epipolar constraint: what lies before both cameras is on one side of the epipolar geometry


@inner
def consistently_oriented(F: Array, X: Array, size: int) -> Any:
    """Whether ``F x0`` and ``e1 x x1``, the same epipolar line, point the same way for all matches of a sample: a mask.
    Chum, Werner & Matas, "Epipolar geometry estimation via RANSAC benefits from the oriented epipolar constraint"
    (ICPR 2004). A model through a wrong match mostly fails, so a look at the sample alone tells most wrong models.
    F: (9, LANES), of rank two. X: (4 size, LANES), x0, y0, x1, y1 of the matches that each model was made from."""
    f0, f1, f2, f3, f4, f5 = load(F, 0), load(F, 1), load(F, 2), load(F, 3), load(F, 4), load(F, 5)
    f6, f7, f8 = load(F, 6), load(F, 7), load(F, 8)
    # The epipole is across all columns: here two combinations, which no usual epipole makes parallel.
    g0, g1, g2 = f0 + 0.618 * f2, f3 + 0.618 * f5, f6 + 0.618 * f8
    h0, h1, h2 = f1 + 0.414 * f2, f4 + 0.414 * f5, f7 + 0.414 * f8
    ex, ey, ez = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
    ahead = fill(0.0) == 0.0
    behind = ahead
    for j in range(size):
        x0, y0, x1, y1 = load(X, 4 * j), load(X, 4 * j + 1), load(X, 4 * j + 2), load(X, 4 * j + 3)
        a, b = f0 * x0 + f1 * y0 + f2, f3 * x0 + f4 * y0 + f5
        agreement = a * (ey - ez * y1) + b * (ez * x1 - ex)
        ahead &= agreement > 0.0
        behind &= agreement < 0.0
    return ahead | behind
