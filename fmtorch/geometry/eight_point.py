"""The normalised, weighted eight-point algorithm, and the null space of its equations, which minimal solvers share."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry import matrices
from fmtorch.geometry.arithmetic import stable_sum
from fmtorch.geometry.matrices import EPS, nearest_rank2_kernel, smallest_eigenvector_kernel, unit_kernel
from fmtorch.geometry.normalize import canonical, denormalize_fundamental, normalize_points
from fmtorch.geometry.pose import consistently_oriented
from fmtorch.jit.kernel import Array, F4x2, F8x1, F8x2, I8x1, I8x2, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, absolute, copysign, fill, load, sqrt, store, where


def eight_point(
    x0: Float[Tensor, "*batch n 2"], x1: Float[Tensor, "*batch n 2"], weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:  # fmt: skip
    """The fundamental matrix of N >= 8 correspondences by weighted linear least squares, and whether it is valid.

    Points are normalised (Hartley, PAMI 1997; with the weights, so that a point of weight zero is as good as masked),
    F is the smallest eigenvector of M = sum w a a^T, made rank two, denormalised, of unit Frobenius norm with its
    largest entry positive. Differentiable in points and weights (not in a root of the weights, so also at zero).
    Computed in float64, returned in x0's type.

    Args:
        x0: points of image 0, pixels.
        x1: their matches in image 1.
        weight: of each match, not negative, any scale; 1 by default.
        mask: True for a real match; all by default.

    Returns:
        F, and whether it is valid. Invalid (F = 0): fewer than eight independent equations (too few points, coincident
        or collinear ones, an exact plane), or anything not finite, or a negative weight, among the unmasked points. The
        result has the same bits in any batch and with any padding.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import eight_point, sampson
        >>> generator = torch.Generator().manual_seed(0)
        >>> X = torch.rand(20, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 2.0])
        >>> x0 = 500 * X[:, :2] / X[:, 2:]                       # one camera, and one moved to the right and back
        >>> X1 = X + torch.tensor([-0.5, 0.0, 0.2])
        >>> x1 = 500 * X1[:, :2] / X1[:, 2:]
        >>> F, valid = eight_point(x0, x1)
        >>> bool(valid), bool((sampson(F, x0, x1) < 1e-6).all())
        (True, True)
    """
    a, b, w, finite = finite_matches(x0, x1, weight, mask)
    (a, T0), (b, T1) = normalize_points(a, weight=w), normalize_points(b, weight=w)
    linear, determined = linear_fundamental(a, b, w)
    F = canonical(denormalize_fundamental(matrices.nearest_rank2(linear), T0, T1))
    valid = finite & determined & (F.detach() != 0).any(-1).any(-1)
    return torch.where(valid[..., None, None], F, 0.0).to(x0.dtype), valid


def linear_fundamental(
    x0: Float[Tensor, "*points n 2"], x1: Float[Tensor, "*points n 2"], weight: Float[Tensor, "*batch n"]
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """The F of unit norm, of any rank, that minimises sum w (x1^T F x0)^2; False where it is not determined.
    Arguments as of `normal_matrix`."""
    f, determined = matrices.smallest_eigenvector(normal_matrix(x0, x1, weight))
    return f.reshape(*f.shape[:-1], 3, 3), determined


def normal_matrix(
    x0: Float[Tensor, "*points n 2"], x1: Float[Tensor, "*points n 2"], weight: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch 9 9"]:
    """The sum of w a a^T, with a . vec(F) = x1^T F x0. Expects normalised float64 points, finite, with weight zero for
    those that do not count. The points' leading shape broadcasts against that of the weights."""
    # a = x1 (x) x0, so M holds the sums of w (x1 x1^T) (x) (x0 x0^T): 6 x 6 different ones, in parts that fit a cache.
    p0, p1 = _products(x0), weight[..., None, :] * _products(x1)
    sums = torch.cat([stable_sum(part[..., :, None, :] * p0[..., None, :, :], -1) for part in p1.chunk(3, -2)], -2)
    M: Tensor = sums[..., _PRODUCT_INDEX[:, None, :, None], _PRODUCT_INDEX[None, :, None, :]]
    return M.reshape(*sums.shape[:-2], 9, 9)


_PRODUCT_INDEX = torch.tensor([[0, 1, 3], [1, 2, 4], [3, 4, 5]])


def _products(x: Tensor) -> Tensor:
    """The different entries of (x, y, 1) (x, y, 1)^T: (*batch, 6, n)."""
    x, y = x.unbind(-1)
    return torch.stack([x * x, x * y, y * y, x, y, torch.ones_like(x)], -2)


def finite_matches(
    x0: Tensor, x1: Tensor, weight: Tensor | None, mask: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points and weights in float64, zero where they do not count; False for a set in which one cannot be used."""
    w = torch.ones_like(x0[..., 0]) if weight is None else weight
    good = (x0.isfinite() & x1.isfinite()).all(-1) & w.isfinite() & (w >= 0)
    keep = good if mask is None else good & mask
    valid = (good if mask is None else good | ~mask).all(-1)
    x0d, x1d = (torch.where(keep[..., None], x, 0.0).to(torch.float64) for x in (x0, x1))
    wd = torch.where(keep, w, 0.0).to(torch.float64)
    largest = wd.detach().amax(-1, keepdim=True) if wd.shape[-1] else wd.new_ones(*wd.shape[:-1], 1)
    return x0d, x1d, wd / torch.where(largest > 0, largest, 1.0), valid


# The eight-point algorithm on the samples of one pair, and weighted on its matches, compiled; float64

WIDTH = 32  # partial sums over the matches: part of the last bits of a weighted fit


@kernel
def eight_point_kernel(points: F8x2, sample: I8x2, F: F4x2, draw: I8x1) -> int:
    """Consistently oriented models of samples (8, s) of points (4, n) -> F (s, 9), draw (s,); how many there are.
    The models stand in the order of the samples. Buffers are rows of LANES numbers, one per sample."""
    X, N, A, B = matrix(32, LANES), matrix(32, LANES), matrix(72, LANES), matrix(9, LANES)
    work, there = matrix(8, LANES), np.empty((1, LANES), np.bool_)
    centre, scale, f = matrix(4, LANES), matrix(2, LANES), vector(9)
    models = 0
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        for image in range(2):
            _normalise(X, image, N, centre, scale)
        equations(N, 8, A)
        store(there, 0, null_space(A, 8, B, work) & (load(scale, 0) > 0.0) & (load(scale, 1) > 0.0))
        for lane in range(LANES):
            for q in range(9):
                f[q] = B[q, lane]
            nearest_rank2_kernel(f)
            for image in range(2):
                _denormalise(f, image, scale[image, lane], centre[2 * image, lane], centre[2 * image + 1, lane])
            norm = unit_kernel(f)
            for q in range(9):
                B[q, lane] = f[q]
            there[0, lane] &= norm > 0 and math.isfinite(norm)
        store(there, 0, load(there, 0) & consistently_oriented(B, X, 8))
        models = add_models(B.reshape(1, 9, LANES), there, first, F, draw, models, sample.shape[1])
    return models


@inner
def _normalise(X: Array, image: int, N: Array, centre: Array, scale: Array) -> None:
    """Each sample's points in one image, normalised (Hartley 1997) -> N, centre and scale; scale 0: no spread."""
    x, y = 2 * image, 2 * image + 1  # rows of each point
    cx, cy, mean = fill(0.0), fill(0.0), fill(0.0)
    for j in range(0, 32, 4):
        cx += load(X, j + x)
        cy += load(X, j + y)
    cx, cy = cx / 8.0, cy / 8.0
    for j in range(0, 32, 4):
        dx, dy = load(X, j + x) - cx, load(X, j + y) - cy
        mean += sqrt(dx * dx + dy * dy)
    mean /= 8.0
    farthest = where(absolute(cx) > absolute(cy), absolute(cx), absolute(cy))
    spread = mean > 4 * EPS * farthest
    by = where(spread, 2**0.5 / mean, 1.0)
    for j in range(0, 32, 4):
        store(N, j + x, (load(X, j + x) - cx) * by)
        store(N, j + y, (load(X, j + y) - cy) * by)
    store(centre, x, cx)
    store(centre, y, cy)
    store(scale, image, where(spread, by, 0.0))


@inner
def _denormalise(f: Array, image: int, s: float, cx: float, cy: float) -> None:
    """F for points of image 0 (or of image 1: F's rows) before they were moved from (cx, cy) and scaled, in place."""
    across, along = (1, 3) if image == 0 else (3, 1)
    for k in range(3):
        a, b, c = k * along, k * along + across, k * along + 2 * across
        f[a], f[b] = f[a] * s, f[b] * s
        f[c] -= f[a] * cx + f[b] * cy


@kernel
def weighted_eight_point(points: F8x2, weight: F8x1, F: F8x1) -> bool:
    """The F of least sum w (x1^T F x0)^2, made rank two, of unit norm, largest entry positive -> F (9,).
    `eight_point.eight_point` of points (4, n) and weights (n,), not negative: whether there is one."""
    n, largest = len(weight), 0.0
    for i in range(n):
        largest = max(largest, weight[i])
    if not (largest > 0 and math.isfinite(largest)):
        return False
    blocks = (n + WIDTH - 1) // WIDTH
    X, w = np.zeros((4, blocks * WIDTH)), np.zeros(blocks * WIDTH)
    similarity = matrix(2, 3)
    for i in range(n):
        w[i] = weight[i] / largest
        for k in range(4):
            X[k, i] = points[k, i]
    for image in range(2):
        _similarity(X[2 * image], X[2 * image + 1], w, similarity[image])
    if not smallest_eigenvector_kernel(_normal_matrix(X, w), F):
        return False
    nearest_rank2_kernel(F)
    for image in range(2):
        _denormalise(F, image, similarity[image, 0], similarity[image, 1], similarity[image, 2])
    peak, norm = 0, 0.0
    for q in range(9):
        peak = q if abs(F[q]) > abs(F[peak]) else peak
    for q in range(9):
        norm += F[q] * F[q]
    norm = math.copysign(math.sqrt(norm), F[peak])
    for q in range(9):
        F[q] /= norm
    return math.isfinite(norm) and norm != 0


@inner
def _similarity(x: Array, y: Array, w: Array, out: Array) -> None:
    """Normalises points (n,) in place; their scale and centre -> out (3,). The means are weighted."""
    total, sums = 0.0, np.zeros((4, WIDTH))
    for b in range(0, len(w), WIDTH):
        for i in range(WIDTH):
            sums[0, i] += w[b + i]
            sums[1, i] += w[b + i] * x[b + i]
            sums[2, i] += w[b + i] * y[b + i]
    total, cx, cy, mean = _added(sums[0]), _added(sums[1]), _added(sums[2]), 0.0
    cx, cy = cx / total, cy / total
    for b in range(0, len(w), WIDTH):
        for i in range(WIDTH):
            x[b + i] -= cx
            y[b + i] -= cy
            sums[3, i] += w[b + i] * math.sqrt(x[b + i] * x[b + i] + y[b + i] * y[b + i])
    mean = _added(sums[3]) / total
    scale = 2**0.5 / mean if mean > 4 * EPS * max(abs(cx), abs(cy)) else 1.0
    for i in range(len(w)):
        x[i], y[i] = x[i] * scale, y[i] * scale
    out[0], out[1], out[2] = scale, cx, cy


@inner
def _added(sums: Array) -> Any:
    """The sum of WIDTH partial sums, in order."""
    total = 0.0
    for i in range(WIDTH):
        total += sums[i]
    return total


@inner
def _normal_matrix(X: Array, w: Array) -> Array:
    """The sum of w a a^T with a . vec(F) = x1^T F x0, (9, 9), of points (4, n), n a multiple of WIDTH."""
    p, q, sums = matrix(6, WIDTH), matrix(6, WIDTH), np.zeros((36, WIDTH))
    for b in range(0, len(w), WIDTH):
        for i in range(WIDTH):
            x0, y0, x1, y1, v = X[0, b + i], X[1, b + i], X[2, b + i], X[3, b + i], w[b + i]
            p[0, i], p[1, i], p[2, i], p[3, i], p[4, i], p[5, i] = x0 * x0, x0 * y0, y0 * y0, x0, y0, 1.0
            q[0, i], q[1, i], q[2, i] = v * (x1 * x1), v * (x1 * y1), v * (y1 * y1)
            q[3, i], q[4, i], q[5, i] = v * x1, v * y1, v
        for r in range(6):
            for c in range(6):
                for i in range(WIDTH):
                    sums[6 * r + c, i] += q[r, i] * p[c, i]
    M, product = matrix(9, 9), np.array(((0, 1, 3), (1, 2, 4), (3, 4, 5)))
    for i in range(9):
        for j in range(9):
            M[i, j] = _added(sums[6 * product[i // 3, j // 3] + product[i % 3, j % 3]])
    return M


# The null space of wide matrices by Householder reflections, LANES samples at a time; buffers are rows of LANES numbers

RANK_TOLERANCE2 = float((64 * np.finfo(np.float64).eps) ** 2)  # of a row's squared length: what is left is rounding


@inner
def gather(points: Array, sample: Array, first: int, X: Array) -> None:
    """Points (4, n) of the samples (size, s) from `first` on -> X (4 size, LANES); the last fills what is left."""
    for lane in range(LANES):
        column = min(first + lane, sample.shape[1] - 1)
        for j in range(len(sample)):
            i = sample[j, column]
            for k in range(4):
                X[4 * j + k, lane] = points[k, i]


@inner
def add_models(f: Array, there: Array, first: int, F: Array, draw: Array, models: int, samples: int) -> int:
    """Adds the models f (k, 9, LANES) that are there (k, LANES), of the samples from `first` on, to F and draw.
    models: in these so far. samples: in all. Returns how many models there are then."""
    for lane in range(min(LANES, samples - first)):
        for k in range(len(there)):
            if there[k, lane]:
                for q in range(9):
                    F[models, q] = f[k, q, lane]
                draw[models] = first + lane
                models += 1
    return models


@inner
def equations(X: Array, size: int, A: Array) -> None:
    """The rows a with a . vec(F) = x1^T F x0 of points X (4 size, LANES) -> A (9 size, LANES)."""
    for j in range(size):
        o, p = 9 * j, 4 * j
        x0, y0, x1, y1 = load(X, p), load(X, p + 1), load(X, p + 2), load(X, p + 3)
        store(A, o, (x1 * x0, x1 * y0, x1, y1 * x0, y1 * y0, y1, x0, y0, fill(1.0)))


@inner
def null_space(A: Array, m: int, B: Array, scale: Array) -> Any:
    """An orthonormal basis of the null space of A (m 9, LANES), which is overwritten -> B ((9 - m) 9, LANES).
    The last columns of Q in A^T = Q R (Golub and Van Loan, Matrix Computations, section 5.2); A^T A, whose condition is
    squared, is never formed. Not scaled against overflow: entries should be of about unit size. Returns a mask: whether
    each matrix has rank m, without which its basis is finite but means nothing. scale: (m, LANES), for the work."""
    full_rank = fill(0.0) == 0.0
    for k in range(m):
        length2 = _dot(A, 9 * k, A, 9 * k, 9)
        for earlier in range(k):  # the reflections so far
            _reflect(A, 10 * earlier, A, 9 * k + earlier, 9 - earlier, load(scale, earlier))
        head = 10 * k
        left = _dot(A, head, A, head, 9 - k)
        full_rank &= left > RANK_TOLERANCE2 * length2
        first = load(A, head)
        shift = copysign(sqrt(where(left > 0.0, left, 1.0)), first)
        store(A, head, first + shift)
        store(scale, k, 1.0 / (shift * (first + shift)))
    for j in range(9 - m):
        for c in range(9):
            store(B, 9 * j + c, fill(1.0 if c == m + j else 0.0))
        for k in range(m - 1, -1, -1):
            _reflect(A, 10 * k, B, 9 * j + k, 9 - k, load(scale, k))
    return full_rank


@inner
def _dot(A: Array, a: int, B: Array, b: int, n: int) -> Any:
    total = fill(0.0)
    for c in range(n):
        total += load(A, a + c) * load(B, b + c)
    return total


@inner
def _reflect(A: Array, a: int, B: Array, b: int, n: int, scale: Any) -> None:
    """Reflects the n components of B from b on across the plane normal to those of A from a on."""
    along = _dot(A, a, B, b, n) * scale
    for c in range(n):
        store(B, b + c, load(B, b + c) - along * load(A, a + c))
