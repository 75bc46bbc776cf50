"""Small matrices in fixed-order arithmetic: the nearest of rank two, the eigenvector of the smallest eigenvalue.

`torch.linalg.eigh` rounds differently with the memory alignment of each matrix, so the same matrix gives different
last bits in different batch positions. These functions do not. Those that solvers with gradients and kernels need have
two forms."""

import math
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors, component_sum, determinant, outer_sum, sqrt
from fmtorch.jit.kernel import Array, inner, matrix, vector

GAP = 1e-6  # eigenvalue gaps of F^T F below this share of its largest eigenvalue have their gradient held finite


def nearest_rank2(F: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rank-two matrix nearest to F in Frobenius norm, F - F v v^T, v being the last right singular vector.
    Computed in float64, returned in F's type. Differentiable; where the two smallest singular values meet, v and with
    it the projection jump, and the gradient has gap / (gap^2 + eps^2) in place of 1 / gap. F must be finite."""
    rows = F.reshape(*F.shape[:-2], 9).movedim(-1, 0).contiguous().to(torch.float64).reshape(3, 3, *F.shape[:-2])
    v = last_right_singular_vector(rows)
    projected = rows - component_sum(rows * v, 1)[:, None] * v
    return projected.flatten(0, 1).to(F.dtype).movedim(0, -1).reshape(F.shape)


def last_right_singular_vector(F: Float[Tensor, " 3 3 *s"]) -> Float[Tensor, " 3 *s"]:
    """The unit right singular vector v of the smallest singular value, float64; F[i, j] is row i, column j.
    The cofactor matrix C of F has v for its *first* right singular vector, and singular values s1 s2, s1 s3, s2 s3: so
    v belongs to the largest eigenvalue of C^T C, which is well determined whenever s3 < s2, while the smallest one of
    F^T F has lost half of its digits."""
    with torch.no_grad():
        G = _scaled(F.detach())
        C = cofactors(G)
        rank_one = C.abs().amax((0, 1)) < 8 * torch.finfo(C.dtype).eps
        C = _scaled(C)
        v = _largest_eigenvector(component_sum(C[:, :, None] * C[:, None], 0))
        v = torch.where(rank_one, _across_longest(G), v)
        # C loses digits when s2 << s1; a step down the slope of |F v|^2 takes out what is left along the first vector.
        norm2 = component_sum(component_sum(G * G, 1))
        slope = component_sum(G * component_sum(G * v, 1)[:, None], 0)
        v = _unit(v - slope / torch.where(norm2 > 0, norm2, 1.0), v)
    return _attach(F, v) if F.requires_grad else v


def _attach(F: Tensor, v: Tensor) -> Tensor:
    """v with the gradient of an eigenvector of M = F^T F: dv = -(M - s3^2)^+ dM v, the pseudo-inverse kept bounded."""
    with torch.no_grad():
        M = component_sum(F[:, :, None] * F[:, None], 0)
        smallest = component_sum(v * component_sum(M * v, 1))
        p, q = complement(v)
        Mp, Mq = component_sum(M * p, 1), component_sum(M * q, 1)
        # B = (M - s3^2) on the plane across v, in the basis p, q; (B^2 + eps^2)^-1 B is gap / (gap^2 + eps^2).
        b00, b01, b11 = (component_sum(s * t) for s, t in ((p, Mp), (p, Mq), (q, Mq)))
        b00, b11 = b00 - smallest, b11 - smallest
        eps2 = (GAP * (M[0, 0] + M[1, 1] + M[2, 2])) ** 2
        s00, s01, s11 = b00 * b00 + b01 * b01 + eps2, b01 * (b00 + b11), b01 * b01 + b11 * b11 + eps2
        area = s00 * s11 - s01 * s01
        inverse = torch.where(area > 0, 1.0 / torch.where(area > 0, area, 1.0), 0.0)
        i00 = (s11 * b00 - s01 * b01) * inverse
        i01 = (s11 * b01 - s01 * b11) * inverse
        i11 = (s00 * b11 - s01 * b01) * inverse
    Fv = component_sum(F * v, 1)
    Mv = component_sum(F * Fv[:, None], 0)
    change = Mv - Mv.detach()
    along_p, along_q = component_sum(p * change), component_sum(q * change)
    return v - (p * (i00 * along_p + i01 * along_q) + q * (i01 * along_p + i11 * along_q))


def _scaled(A: Tensor) -> Tensor:
    """A over its largest entry, so that no product over- or underflows."""
    peak = A.abs().amax((0, 1))
    return A / torch.where(peak > 0, peak, 1.0)


def _unit(x: Tensor, fallback: Tensor) -> Tensor:
    """x at unit length, or `fallback` where it has none."""
    norm2 = component_sum(x * x)
    return torch.where(norm2 > 0, x / sqrt(torch.where(norm2 > 0, norm2, 1.0)), fallback)


def _largest_eigenvector(K: Tensor) -> Tensor:
    """The unit eigenvector of the largest eigenvalue of symmetric 3 x 3 matrices (3, 3, *s); any, where it is multiple.
    The eigenvector is the longest cross product of two rows of K - lambda."""
    _, _, X, constant, y = extreme_root(K)
    middle = (sqrt(3 * (2 - y).clamp_min(0) * (2 + y)) + y) / 2
    largest = torch.where(constant >= 0, y, middle)
    for i in range(3):
        X[i, i] = X[i, i] - largest
    candidates = cofactors(X)
    length2 = component_sum(candidates * candidates, 1)
    best = length2.argmax(0)
    chosen = torch.gather(candidates, 0, best[None, None].expand(1, 3, *best.shape))[0]
    # A double eigenvalue leaves X - lambda of rank one (all products vanish): any vector across its rows will do.
    # With L the length of the longest product, the product is good to eps / L and the other choice to L.
    across = _across_longest(X)
    distinct = length2.amax(0) > torch.finfo(K.dtype).eps
    return torch.where(distinct, _unit(chosen, across), across)


def extreme_root(K: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Of symmetric 3 x 3 matrices mean, m and X, ``K = mean + m X``, det X, and the extreme root of
    ``y^3 - 3 y = |det X|``; the eigenvalues of X are the roots without the magnitude."""
    mean = (K[0, 0] + K[1, 1] + K[2, 2]) / 3
    D = K.clone()
    for i in range(3):
        D[i, i] = K[i, i] - mean
    m = sqrt(component_sum(component_sum(D * D, 1)) / 6)
    X = D / torch.where(m > 0, m, 1.0)
    constant = determinant(X).clamp(-2.0, 2.0)
    y = torch.full_like(m, 2.0)
    for _ in range(5):  # Newton's method, quadratic from an error of at most 0.27
        y = (2 * y * y * y + constant.abs()) / (3 * (y * y - 1))
    return mean, m, X, constant, y


def _across_longest(A: Tensor) -> Tensor:
    """A unit vector perpendicular to the longest row of A."""
    longest = component_sum(A * A, 1).argmax(0)
    row = torch.gather(A, 0, longest[None, None].expand(1, 3, *longest.shape))[0]
    return complement(_unit(row, torch.zeros_like(row)))[0]


def complement(v: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors that complete v to an orthonormal basis (Duff et al., JCGT 2017); for v = 0, two axes."""
    sign = torch.copysign(torch.ones_like(v[2]), v[2])
    a = -1.0 / (sign + v[2])
    b = v[0] * v[1] * a
    p = torch.stack([1.0 + sign * v[0] * v[0] * a, sign * b, -sign * v[0]])
    q = torch.stack([b, sign + v[1] * v[1] * a, -v[1]])
    return p, q


# The eigenvector of the smallest eigenvalue of symmetric 9 x 9, or other small, matrices

SHIFT = 1e-14  # relative to the trace: above the rounding error of the factorisation, below any eigenvalue that counts
RANK_TOLERANCE = 1e-12  # relative to the trace: relative errors of 1e-6 in the rows that M was summed from
EIGENVALUE_GAP = 1e-8  # relative to the trace: eigenvalue gaps below it have their gradient held finite
SQUARINGS = 14  # the power 2^14 parts eigenvalues whose ratio is 0.998


def smallest_eigenvector(M: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """The unit eigenvector of the smallest eigenvalue of positive semi-definite M, and whether it is determined.
    Inverse iteration by repeated squaring: with M = L D L^T, the powers M^-1, M^-2, M^-4, ... (each at unit trace) turn
    into v v^T. The largest entry of v is positive. It counts as determined when the rank is at least n - 1, that is
    when the trace of M^-1 across v is not too large. M must be finite, float64. Gradient: with gaps g_j to the smallest
    eigenvalue, sum_j v_j v_j^T g_j / (g_j^2 + eps^2) over the other eigenvectors, finite where eigenvalues meet."""
    return cast(tuple[Tensor, Tensor], _SmallestEigenvector.apply(M))  # type: ignore[no-untyped-call]


class _SmallestEigenvector(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, M: Tensor) -> tuple[Tensor, Tensor]:
        v, determined = _inverse_power(M.movedim((-2, -1), (0, 1)).contiguous())
        v = v.movedim(0, -1).contiguous()
        ctx.save_for_backward(M, v)
        ctx.mark_non_differentiable(determined)
        return v, determined

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        M, v = ctx.saved_tensors
        trace = M.diagonal(dim1=-2, dim2=-1).sum(-1)
        values, vectors = torch.linalg.eigh(M / torch.where(trace > 0, trace, 1.0)[..., None, None])
        gap = values[..., 1:] - values[..., :1]
        bounded = gap / (gap * gap + EIGENVALUE_GAP * EIGENVALUE_GAP)
        others = vectors[..., 1:]
        along = bounded * (others.mT @ gradients[0][..., None])[..., 0]
        u = (others @ along[..., None])[..., 0] / torch.where(trace > 0, trace, 1.0)[..., None]
        outer: Tensor = u[..., :, None] * v[..., None, :]
        return -(outer + outer.mT) / 2


def _inverse_power(M: Tensor) -> tuple[Tensor, Tensor]:
    """`smallest_eigenvector` with the matrix axes first: (n, n, *s) to (n, *s)."""
    n = M.shape[0]
    trace = component_sum(M.diagonal(dim1=0, dim2=1).movedim(-1, 0))
    nonzero = trace > 0
    A = M / torch.where(nonzero, trace, 1.0)
    for i in range(n):
        A[i, i] += SHIFT
    inverse_of_L = torch.eye(n, dtype=M.dtype, device=M.device)
    inverse_of_L = inverse_of_L.reshape(n, n, *[1] * (M.dim() - 2)).repeat(1, 1, *M.shape[2:])
    pivots = []
    for i in range(n):
        pivot = A[0, 0].clamp_min(SHIFT / 2)
        column = A[1:, 0] / pivot
        inverse_of_L[i + 1 :, : i + 1] -= column[:, None] * inverse_of_L[i, : i + 1]
        A = A[1:, 1:] - column[:, None] * A[0, 1:]
        pivots.append(pivot)
    inverse = outer_sum((inverse_of_L / torch.stack(pivots)[:, None])[:, :, None], inverse_of_L[:, None])
    size = _trace(inverse)
    X = inverse = inverse / size
    done = torch.zeros_like(nonzero)
    for _ in range(SQUARINGS):
        squared = outer_sum(X[:, :, None], X[:, None])
        trace = _trace(squared)
        X = torch.where(done, X, squared / trace)
        done = done | (trace > 1 - 1e-14)
        if bool(done.all()):
            break
    best = X.diagonal(dim1=0, dim2=1).movedim(-1, 0).argmax(0)
    v = torch.gather(X, 0, best[None, None].expand(1, *X.shape[1:]))[0]
    v = v / sqrt(component_sum(v * v))
    across = (1 - component_sum(v * component_sum(inverse * v, 1))) * size  # the sum of 1 / eigenvalue over the others
    return v, nonzero & (across * RANK_TOLERANCE < 1)


def _trace(X: Tensor) -> Tensor:
    return component_sum(X.diagonal(dim1=0, dim2=1).movedim(-1, 0))


# The nearest matrix of rank two, compiled: matrices are (9,), row by row

EPS = float(np.finfo(np.float64).eps)


@inner
def assign(target: Array, source: Array) -> None:
    """Copies vectors. (A slice assigned to a slice takes seconds to compile.)"""
    for i in range(len(target)):
        target[i] = source[i]


@inner
def assign_rows(target: Array, source: Array) -> None:
    """Copies matrices."""
    for i in range(len(target)):
        assign(target[i], source[i])


@inner
def cofactors_kernel(F: Array, C: Array) -> None:
    """The matrix of cofactors of F -> C."""
    C[0], C[1], C[2] = F[4] * F[8] - F[5] * F[7], F[5] * F[6] - F[3] * F[8], F[3] * F[7] - F[4] * F[6]
    C[3], C[4], C[5] = F[7] * F[2] - F[8] * F[1], F[8] * F[0] - F[6] * F[2], F[6] * F[1] - F[7] * F[0]
    C[6], C[7], C[8] = F[1] * F[5] - F[2] * F[4], F[2] * F[3] - F[0] * F[5], F[0] * F[4] - F[1] * F[3]


@inner
def unit_kernel(v: Array) -> Any:
    """Scales to unit norm, in place; NaN where that is not possible. The norm that it had."""
    total = 0.0
    for i in range(len(v)):
        total += v[i] * v[i]
    norm = math.sqrt(total)
    for i in range(len(v)):
        v[i] /= norm
    return norm


@inner
def complement_kernel(v: Array, p: Array, q: Array) -> None:
    """Two unit vectors that complete v to an orthonormal basis (Duff et al., JCGT 2017) -> p, q."""
    sign = math.copysign(1.0, v[2])
    a = -1.0 / (sign + v[2])
    b = v[0] * v[1] * a
    p[0], p[1], p[2] = 1.0 + sign * v[0] * v[0] * a, sign * b, -sign * v[0]
    q[0], q[1], q[2] = b, sign + v[1] * v[1] * a, -v[1]


@inner
def nearest_rank2_kernel(F: Array) -> None:
    """Makes F the nearest matrix of rank two, F - F v v^T, in place, as `nearest_rank2`."""
    v = vector(3)
    last_right_singular_vector_kernel(F, v)
    for r in range(3):
        along = F[3 * r] * v[0] + F[3 * r + 1] * v[1] + F[3 * r + 2] * v[2]
        for c in range(3):
            F[3 * r + c] -= along * v[c]


@inner
def last_right_singular_vector_kernel(F: Array, v: Array) -> None:
    """The unit right singular vector of the smallest singular value -> v, as `last_right_singular_vector`."""
    G, C, K = vector(9), vector(9), vector(9)
    for i in range(9):
        G[i] = F[i]
    _scale(G)
    cofactors_kernel(G, C)
    if _scale(C) < 8 * EPS:
        _across_longest_kernel(G, v)
    else:
        for r in range(3):
            for c in range(3):
                K[3 * r + c] = C[r] * C[c] + C[3 + r] * C[3 + c] + C[6 + r] * C[6 + c]
        _largest_eigenvector_kernel(K, v)
    # The cofactors lose digits when s2 << s1; a step down the slope of |F v|^2 takes out what is left of the first.
    norm2, slope, size = 0.0, np.zeros(3), 0.0
    for r in range(3):
        along = G[3 * r] * v[0] + G[3 * r + 1] * v[1] + G[3 * r + 2] * v[2]
        for c in range(3):
            slope[c] += G[3 * r + c] * along
            norm2 += G[3 * r + c] * G[3 * r + c]
    for c in range(3):
        slope[c] = v[c] - slope[c] / (norm2 if norm2 > 0 else 1.0)
        size += slope[c] * slope[c]
    if size > 0:
        for c in range(3):
            v[c] = slope[c] / math.sqrt(size)


@inner
def _scale(A: Array) -> Any:
    """A over its largest entry, in place; that entry's magnitude."""
    peak = 0.0
    for i in range(9):
        peak = max(peak, abs(A[i]))
    if peak > 0:
        for i in range(9):
            A[i] /= peak
    return peak


@inner
def _longest(A: Array) -> tuple[int, float]:
    """The longest row of A and its squared length."""
    best, most = 0, -1.0
    for r in range(3):
        length2 = A[3 * r] * A[3 * r] + A[3 * r + 1] * A[3 * r + 1] + A[3 * r + 2] * A[3 * r + 2]
        if length2 > most:
            best, most = r, length2
    return best, most


@inner
def _across_longest_kernel(A: Array, v: Array) -> None:
    """A unit vector perpendicular to the longest row of A -> v."""
    row, other = np.zeros(3), vector(3)
    best, length2 = _longest(A)
    for c in range(3):
        row[c] = A[3 * best + c] / math.sqrt(length2) if length2 > 0 else 0.0
    complement_kernel(row, v, other)


@inner
def _largest_eigenvector_kernel(K: Array, v: Array) -> None:
    """The unit eigenvector of the largest eigenvalue of a symmetric matrix -> v; K is overwritten."""
    mean, squares = (K[0] + K[4] + K[8]) / 3, 0.0
    for i in range(0, 9, 4):
        K[i] -= mean
    for i in range(9):
        squares += K[i] * K[i]
    m = math.sqrt(squares / 6)
    for i in range(9):
        K[i] /= m if m > 0 else 1.0
    C = vector(9)
    cofactors_kernel(K, C)
    determinant = min(max(K[0] * C[0] + K[1] * C[1] + K[2] * C[2], -2.0), 2.0)
    y = 2.0
    for _ in range(5):
        y = (2 * y * y * y + abs(determinant)) / (3 * (y * y - 1))
    largest = y if determinant >= 0 else (math.sqrt(3 * max(2 - y, 0.0) * (2 + y)) + y) / 2
    for i in range(0, 9, 4):
        K[i] -= largest
    cofactors_kernel(K, C)
    best, length2 = _longest(C)
    if length2 > EPS:
        for c in range(3):
            v[c] = C[3 * best + c] / math.sqrt(length2)
    else:
        _across_longest_kernel(K, v)


@inner
def smallest_eigenvector_kernel(M: Array, v: Array) -> bool:
    """`smallest_eigenvector` of a symmetric matrix (n, n), overwritten -> v; whether it is determined."""
    n, trace = len(M), 0.0
    for i in range(n):
        trace += M[i, i]
    if not (trace > 0 and math.isfinite(trace)):
        return False
    L, X, Y = np.eye(n), matrix(n, n), matrix(n, n)
    pivot = vector(n)
    for i in range(n):
        for j in range(n):
            M[i, j] /= trace
        M[i, i] += SHIFT
    for k in range(n):  # M = L D L^T; L becomes the inverse of L
        pivot[k] = max(M[k, k], SHIFT / 2)
        for i in range(k + 1, n):
            factor = M[i, k] / pivot[k]
            for j in range(k + 1):
                L[i, j] -= factor * L[k, j]
            for j in range(k + 1, n):
                M[i, j] -= factor * M[k, j]
    size = 0.0
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += L[k, i] / pivot[k] * L[k, j]
            X[i, j] = total
        size += X[i, i]
    inverse = X / size
    X = inverse.copy()
    for _ in range(SQUARINGS):
        trace = 0.0
        for i in range(n):
            for j in range(n):
                Y[i, j] = 0.0
            for k in range(n):
                for j in range(n):
                    Y[i, j] += X[i, k] * X[k, j]
            trace += Y[i, i]
        for i in range(n):
            for j in range(n):
                X[i, j] = Y[i, j] / trace
        if trace > 1 - 1e-14:
            break
    best, norm, along = 0, 0.0, 0.0
    for i in range(n):
        best = i if X[i, i] > X[best, best] else best
    for i in range(n):
        norm += X[best, i] * X[best, i]
    for i in range(n):
        v[i] = X[best, i] / math.sqrt(norm)
    for i in range(n):
        for j in range(n):
            along += v[i] * inverse[i, j] * v[j]
    return (1 - along) * size * RANK_TOLERANCE < 1


# 3 x 3 matrices (9,), row by row, compiled: products, inverses, orthogonal factors

POLAR_STEPS = 10  # quadratic once near; scaled, so that few are needed before


@inner
def multiply(A: Array, B: Array, out: Array) -> None:
    """A B -> out, another array."""
    for r in range(3):
        for c in range(3):
            out[3 * r + c] = A[3 * r] * B[c] + A[3 * r + 1] * B[3 + c] + A[3 * r + 2] * B[6 + c]


@inner
def invert(A: Array, out: Array) -> bool:
    """A^-1 -> out; False where there is none."""
    C = vector(9)
    cofactors_kernel(A, C)
    determinant = A[0] * C[0] + A[1] * C[1] + A[2] * C[2]
    for r in range(3):
        for c in range(3):
            out[3 * r + c] = C[3 * c + r] / determinant
    return determinant != 0 and math.isfinite(determinant)


@inner
def orthogonal_factor(A: Array) -> bool:
    """The rotation nearest to A or -A, in place, by Newton's iteration (Higham 1986). False where A is singular."""
    C = vector(9)
    for _ in range(POLAR_STEPS):
        cofactors_kernel(A, C)
        determinant = A[0] * C[0] + A[1] * C[1] + A[2] * C[2]
        if not (determinant != 0 and math.isfinite(determinant)):
            return False
        squares, inverse = 0.0, 0.0
        for k in range(9):
            squares += A[k] * A[k]
            inverse += C[k] * C[k] / (determinant * determinant)
        scale = math.sqrt(math.sqrt(inverse / squares))
        scale = scale if determinant > 0 else -scale
        for k in range(9):
            A[k] = (scale * A[k] + C[k] / (determinant * scale)) / 2
    return True
