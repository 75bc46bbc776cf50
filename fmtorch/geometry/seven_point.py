"""The seven-point algorithm."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors
from fmtorch.geometry.eight_point import add_models, equations, gather, null_space
from fmtorch.geometry.normalize import canonical, denormalize_fundamental, normalize_points
from fmtorch.geometry.pose import consistently_oriented
from fmtorch.jit.kernel import Array, B1x2, F4x2, F8x2, F8x3, I8x1, I8x2, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, absolute, load, store

HALF = 0.5**0.5


@kernel
def seven_point_kernel(points: F8x2, sample: I8x2, F: F4x2, draw: I8x1) -> int:
    """Consistently oriented models of samples (7, s) of points (4, n) -> F (3 s, 9), draw (3 s,); how many there are.
    They stand in the order of the samples, and of one sample in that of the roots of its cubic."""
    X, f, there = matrix(28, LANES), np.empty((3, 9, LANES)), np.empty((3, LANES), np.bool_)
    models, work = 0, _room()
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        _solve(X, work, f, there)
        for k in range(3):
            store(there, k, load(there, k) & consistently_oriented(f[k], X, 7))
        models = add_models(f, there, first, F, draw, models, sample.shape[1])
    return models


@kernel
def all_seven_point(points: F8x2, sample: I8x2, F: F8x3, valid: B1x2) -> None:
    """All models of samples (7, s) of points (4, n) -> F (s, 3, 9), of unit norm or 0; which are models -> valid."""
    X, f, there = matrix(28, LANES), np.empty((3, 9, LANES)), np.empty((3, LANES), np.bool_)
    work = _room()
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        _solve(X, work, f, there)
        for lane in range(min(LANES, sample.shape[1] - first)):
            for k in range(3):
                valid[first + lane, k] = there[k, lane]
                for q in range(9):
                    F[first + lane, k, q] = f[k, q, lane] if there[k, lane] else 0.0


@inner
def _room() -> Any:
    """Buffers of `_solve`: equations, null space, its scales, determinants, mixtures, and which samples have rank 7."""
    full_rank = np.empty((1, LANES), np.bool_)
    return matrix(63, LANES), matrix(18, LANES), matrix(7, LANES), matrix(4, LANES), matrix(6, LANES), full_rank


@inner
def _solve(X: Array, work: Any, f: Array, there: Array) -> None:
    """Of LANES samples X (28, LANES) the singular matrices of the null space -> f (3, 9, LANES), there (3, LANES).
    The null space is spanned by F0 and F1; det(a F0 + b F1) = 0 is a cubic (Hartley and Zisserman, 11.1.2)."""
    A, B, scale, p, mixed, full_rank = work
    equations(X, 7, A)
    store(full_rank, 0, null_space(A, 7, B, scale))
    _determinants(B, p)
    for lane in range(LANES):
        _mixtures(p, lane, full_rank[0, lane], mixed, there)
    for k in range(3):
        a, b = load(mixed, 2 * k), load(mixed, 2 * k + 1)
        finite = load(there, k)
        for q in range(9):
            value = a * load(B, q) + b * load(B, 9 + q)
            finite &= absolute(value) < math.inf
            store(f[k], q, value)
        store(there, k, finite)


@inner
def _determinants(B: Array, p: Array) -> None:
    """det(a F0 + b F1) at (1, 0), (0, 1), and their sum and difference over the root of two -> p (4, LANES)."""
    f = matrix(9, LANES)
    for k in range(4):
        a, b = (1.0 - k, float(k)) if k < 2 else (HALF, HALF if k == 2 else -HALF)
        for q in range(9):
            store(f, q, a * load(B, q) + b * load(B, 9 + q))
        c0 = load(f, 4) * load(f, 8) - load(f, 5) * load(f, 7)
        c1 = load(f, 5) * load(f, 6) - load(f, 3) * load(f, 8)
        c2 = load(f, 3) * load(f, 7) - load(f, 4) * load(f, 6)
        store(p, k, load(f, 0) * c0 + load(f, 1) * c1 + load(f, 2) * c2)


@inner
def _mixtures(p: Array, lane: int, full_rank: bool, mixed: Array, there: Array) -> None:
    """The singular matrices a F0 + b F1 of a sample -> a, b of each in two rows of mixed; whether there is one."""
    c, roots, valid = vector(4), np.zeros(3), np.zeros(3, np.bool_)
    turned, exchanged = _coefficients(p, lane, c)
    if full_rank:
        cubic_roots(c, roots, valid)
    for k in range(3):
        a = 1.0 / math.sqrt(1.0 + roots[k] * roots[k])
        b = roots[k] * a
        if exchanged:
            a, b = b, a
        if turned:
            a, b = (a + b) * HALF, (a - b) * HALF
        mixed[2 * k, lane], mixed[2 * k + 1, lane], there[k, lane] = a, b, valid[k]


@inner
def _coefficients(p: Array, lane: int, c: Array) -> tuple[bool, bool]:
    """The cubic of a basis that keeps its roots finite -> c (4,); whether it was turned by 45 degrees, exchanged.
    From the determinants at (1, 0), (0, 1), and at their sum and difference over the root of two. The cubic vanishes in
    at most three directions, so one of these four can be sent to infinity: the basis is turned and exchanged until the
    leading coefficient is the largest of the four, and no solution is lost at infinity."""
    best = 0
    for k in range(1, 4):
        if abs(p[k, lane]) > abs(p[best, lane]):
            best = k
    turned, exchanged = best >= 2, best == 0 or best == 2
    first, last, plus, minus = p[0, lane], p[1, lane], p[2, lane], p[3, lane]
    if turned:
        first, last, plus, minus = plus, minus, first, last
    s, d = plus * 2**1.5, minus * 2**1.5
    if exchanged:
        first, last, d = last, first, -d
    c[0], c[1], c[2], c[3] = last, (s + d) / 2 - first, (s - d) / 2 - last, first
    return turned, exchanged


# Real roots of a cubic in closed form, without transcendental functions, polished by Newton's method

NEGLIGIBLE = 1e-60  # relative to the largest coefficient: counts as zero, so that no power over- or underflows
SEPARATION = 1e-4  # relative to the outermost root: the others are found as those of the quadratic that remains
CUBIC_POLISHING_STEPS = 2  # the closed form is good to 1e-8, the quadratic to 1e-4, and Newton's method squares that


@inner
def cubic_roots(c: Array, roots: Array, valid: Array) -> None:
    """The real roots of c[0] z^3 + c[1] z^2 + c[2] z + c[3] -> roots (3,), valid (3,). c is scaled in place.
    Three real roots by Viete's substitution (its extreme root by Newton's method instead of a cosine), one by Cardano's
    formula; both are arranged against cancellation. Leading coefficients may vanish (a quadratic, a line); multiple
    roots fill as many slots. A polynomial that is zero or not finite has none."""
    scale, finite = 0.0, True
    for k in range(4):
        scale, finite = max(scale, abs(c[k])), finite and math.isfinite(c[k])
    for k in range(3):
        valid[k] = False
    if not (scale > 0 and finite):
        return
    for k in range(4):
        c[k] /= scale
        if abs(c[k]) < NEGLIGIBLE:
            c[k] = 0.0
    a, b, d = c[0], c[1], c[3]
    # One root far outside the other two would swamp them in the shift by b / 3a.
    apart = abs(a * c[2]) <= SEPARATION * b * b and a * a * abs(d) <= SEPARATION**2 * (b * b * abs(b)) and b != 0
    if a == 0 or apart:
        _quadratic(b, c[2], d, roots, valid)
        valid[2] = a != 0
        roots[2] = -b / a if a != 0 else 0.0
    else:
        _depressed(a, b, c[2], d, roots, valid)
    for k in range(3):
        z = roots[k]
        for _ in range(CUBIC_POLISHING_STEPS if valid[k] else 0):
            f = ((a * z + b) * z + c[2]) * z + d
            slope = (3 * a * z + 2 * b) * z + c[2]
            better = z - f / (slope if slope != 0 else 1.0)
            if abs(((a * better + b) * better + c[2]) * better + d) < abs(f):
                z = better
        roots[k] = z


@inner
def _depressed(a: float, b: float, c: float, d: float, roots: Array, valid: Array) -> None:
    """Roots through t^3 + 3 P t + 2 Q = 0 with z = t - b / 3a."""
    shift = b / (3 * a)
    P = c / (3 * a) - shift * shift
    Q = shift * shift * shift - shift * c / (2 * a) + d / (2 * a)
    discriminant = Q * Q + P * P * P
    sign = 1.0 if Q < 0 else -1.0
    valid[0] = True
    if discriminant <= 0:  # t = m y, y^3 - 3 y = 2 r with r in [0, 1] and the extreme root y in [sqrt 3, 2]
        m = math.sqrt(max(-P, 0.0))
        m3 = m * m * m
        r = min(abs(Q) / m3, 1.0) if m3 > 0 else 0.0
        y = 2.0
        for _ in range(5):  # quadratic from an error of at most 0.27
            y = (2 * y * y * y + 2 * r) / (3 * (y * y - 1))
        y1 = -(y + math.sqrt(3 * max(2 - y, 0.0) * (2 + y))) / 2
        roots[0], roots[1], roots[2] = y * sign * m - shift, y1 * sign * m - shift, 2 * r / (y * y1) * sign * m - shift
        valid[1], valid[2] = True, True
        return
    u = cube_root(abs(Q) + math.sqrt(discriminant))
    v = P / u
    roots[0] = (u - v if P < 0 else 2 * abs(Q) / (u * u + P + v * v)) * sign - shift


@inner
def _quadratic(a: float, b: float, c: float, roots: Array, valid: Array) -> None:
    """Roots of a z^2 + b z + c, of which a, or a and b, may be zero."""
    discriminant = b * b - 4 * a * c
    real = discriminant >= 0
    w = -(b + math.copysign(math.sqrt(discriminant) if real else 0.0, b)) / 2
    roots[0], roots[1] = 0.0 if w == 0 else c / w, 0.0 if a == 0 else w / a
    valid[0], valid[1] = real and (w != 0 or a != 0), real and a != 0


@inner
def cube_root(x: float) -> Any:
    """The real cube root of a positive number, to the last digits: Halley's method from a third of the exponent."""
    # A third of the bits of x is a cube root to 6 %; the constant makes up for two thirds of the exponent's bias.
    y = np.int64(np.float64(x).view(np.int64) // 3 + 0x2A9F7893782DA1CE).view(np.float64)
    for _ in range(3):  # cubic convergence: 6e-2, 1e-4, 1e-12, 1e-36
        y3 = y * y * y
        y = y * ((y3 + 2 * x) / (2 * y3 + x))
    return y


GAP = 1e-7  # singular values below it have their gradient held finite


def seven_point(
    x0: Float[Tensor, "*batch 7 2"], x1: Float[Tensor, "*batch 7 2"]
) -> tuple[Float[Tensor, "*batch 3 3 3"], Bool[Tensor, "*batch 3"]]:
    """The one to three fundamental matrices of seven correspondences, and which slots hold one (the others are zero).

    Hartley and Zisserman, Multiple View Geometry, 11.1.2, on normalised points, in float64. F has unit Frobenius norm
    and its largest entry positive; it is returned in x0's type. Degenerate samples (repeated points, dependent
    equations, anything not finite) have no valid slot. Differentiable; the gradient stays finite at double roots.
    Values are computed on the CPU.

    Args:
        x0: points in image 0, (..., 7, 2).
        x1: their matches in image 1, (..., 7, 2).

    Returns:
        F (..., 3, 3, 3), three slots of a matrix each, and valid (..., 3).

    Example:
        >>> import torch
        >>> from fmtorch.geometry import sampson, seven_point
        >>> generator = torch.Generator().manual_seed(0)
        >>> x0, x1 = torch.rand(2, 7, 2, generator=generator, dtype=torch.float64) * 500
        >>> F, valid = seven_point(x0, x1)
        >>> bool((sampson(F[valid], x0, x1) < 1e-6).all())
        True
    """
    finite = (x0.isfinite() & x1.isfinite()).all(-1).all(-1)
    x0d, x1d = (torch.where(finite[..., None, None], x, 0.0).to(torch.float64) for x in (x0, x1))
    x0n, T0 = normalize_points(x0d)
    x1n, T1 = normalize_points(x1d)
    F, slots = _solved(x0n, x1n)
    F = canonical(denormalize_fundamental(F, T0[..., None, :, :], T1[..., None, :, :]))
    valid = slots & finite[..., None]
    return torch.where(valid[..., None, None], F, 0.0).to(x0.dtype), valid


def _solved(
    x0: Float[Tensor, "*batch 7 2"], x1: Float[Tensor, "*batch 7 2"]
) -> tuple[Float[Tensor, "*batch 3 3 3"], Bool[Tensor, "*batch 3"]]:
    """The models of normalised samples, by the kernel, on the CPU; attached to the graph of the points."""
    points = torch.cat([x0, x1], -1).detach().cpu().reshape(-1, 4).T.contiguous().numpy()
    sample = np.ascontiguousarray(np.arange(points.shape[1]).reshape(-1, 7).T)
    F, valid = np.empty((sample.shape[1], 3, 9)), np.empty((sample.shape[1], 3), np.bool_)
    all_seven_point(points, sample, F, valid)
    models = torch.from_numpy(F).to(x0.device).reshape(*x0.shape[:-2], 3, 3, 3)
    slots = torch.from_numpy(valid).to(x0.device).reshape(*x0.shape[:-2], 3)
    if torch.is_grad_enabled() and (x0.requires_grad or x1.requires_grad):
        models = _attached(models, x0, x1)
    return models, slots


def _attached(F: Float[Tensor, "*batch 3 3 3"], x0: Tensor, x1: Tensor) -> Float[Tensor, "*batch 3 3 3"]:
    """F, on no graph, attached to that of the points by the implicit function theorem; zero matrices have no gradient.
    The nine entries are determined by the seven equations ``x1^T F x0 = 0``, ``det F = 0`` and the norm. Where roots
    meet, singular values s of these constraints' Jacobian are inverted as ``s / (s^2 + GAP^2)``."""
    h0, h1 = (torch.cat([x, torch.ones_like(x[..., :1])], -1)[..., None, :, :] for x in (x0, x1))
    error = ((h1 @ F) * h0).sum(-1)
    with torch.no_grad():
        equations = (h1[..., :, None] * h0[..., None, :]).flatten(-2).expand(*F.shape[:-2], 7, 9)
        rank = cofactors(F.movedim((-2, -1), (0, 1))).movedim((0, 1), (-2, -1))
        U, s, Vh = torch.linalg.svd(
            torch.cat([equations, rank.flatten(-2)[..., None, :], F.flatten(-2)[..., None, :]], -2)
        )
        inverse = (Vh.mT * (s / (s * s + GAP * GAP))[..., None, :]) @ U.mT
        inverse = torch.where((F != 0).flatten(-2).any(-1)[..., None, None], inverse[..., :7], 0)
    return F - (inverse @ (error - error.detach())[..., None]).reshape(F.shape)
