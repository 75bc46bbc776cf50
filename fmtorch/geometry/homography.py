"""Homographies ``x1 ~ H x0`` in tensors: of four and more matches, and the distances of matches to them.

Points are (..., N, 2) in pixels, matrices (..., 3, 3) of any scale and sign; leading dimensions broadcast. Hartley &
Zisserman (2004), Multiple View Geometry, chapter 4."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry import epipolar
from fmtorch.geometry.arithmetic import cofactors, determinant, matmul3, stable_sum
from fmtorch.geometry.eight_point import add_models, finite_matches, gather
from fmtorch.geometry.epipolar import Matrix, PerMatch, Points, inverse_root, lines_through, unit_largest
from fmtorch.geometry.homography_refine import linearise_homography
from fmtorch.geometry.matrices import EPS, smallest_eigenvector, smallest_eigenvector_kernel, unit_kernel
from fmtorch.geometry.normalize import normalize_points
from fmtorch.jit.kernel import Array, F4x2, F8x1, F8x2, I8x1, I8x2, inner, kernel, matrix, vector
from fmtorch.jit.lanes import LANES, absolute, fill, load, sqrt, store, where

SINGULAR = 1e-12  # determinant of a matrix of unit norm, between normalised points, that counts as zero


def homography(
    x0: Float[Tensor, "*batch n 2"], x1: Float[Tensor, "*batch n 2"], weight: Float[Tensor, "*batch n"] | None = None,
    mask: Bool[Tensor, "*batch n"] | None = None,
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:  # fmt: skip
    """The homography of N >= 4 correspondences by weighted linear least squares, and whether it is valid.

    The normalised DLT (Hartley & Zisserman, algorithm 4.2), exact for four matches: H is the smallest eigenvector of
    the sum of w times the two equations' products, denormalised, of unit Frobenius norm. The third coordinate of H x0
    is positive at the matches, by majority of their weights. Differentiable in points and weights. Computed in
    float64, returned in x0's type.

    Args:
        x0, x1, weight, mask: as of `eight_point`.

    Returns:
        H, and whether it is valid. Invalid (H = 0): fewer than eight independent equations (too few points, coincident
        ones, or all but one on a line), a singular H, or anything not finite, or a negative weight, among the unmasked
        points. The result has the same bits in any batch and with any padding.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import homography, homography_transfer
        >>> x0 = torch.tensor([[0.0, 0.0], [640.0, 0.0], [640.0, 480.0], [0.0, 480.0]], dtype=torch.float64)
        >>> x1 = torch.tensor([[10.0, 20.0], [600.0, 40.0], [610.0, 450.0], [30.0, 400.0]], dtype=torch.float64)
        >>> H, valid = homography(x0, x1)
        >>> bool(valid), bool((homography_transfer(H, x0, x1)[1] < 1e-6).all())
        (True, True)
    """
    a, b, w, finite = finite_matches(x0, x1, weight, mask)
    (a, T0), (b, T1) = normalize_points(a, weight=w), normalize_points(b, weight=w)
    h, determined = smallest_eigenvector(_normal_matrix(a, b, w))
    linear = h.reshape(*h.shape[:-1], 3, 3)
    depth = lines_through(linear.detach(), a.detach())[2]
    side = stable_sum(torch.where(depth > 0, w, -w).detach(), -1)
    regular = determinant(linear.detach().movedim((-2, -1), (0, 1))).abs() > SINGULAR
    s, zero = T1[..., 0, 0], torch.zeros_like(T1[..., 0, 0])
    rows = [torch.ones_like(s), zero, -T1[..., 0, 2], zero, torch.ones_like(s), -T1[..., 1, 2], zero, zero, s]
    back = torch.stack(rows, -1).reshape(T1.shape)  # a multiple of the inverse of [s, 0, tx; 0, s, ty; 0, 0, 1]
    H = epipolar.unit_frobenius(matmul3(matmul3(back, linear), T0))
    H = torch.where((side < 0)[..., None, None], -H, H)
    valid = finite & determined & regular
    return torch.where(valid[..., None, None], H, 0.0).to(x0.dtype), valid


def homography_points(H: Matrix, x0: Points) -> Points:
    """The points of image 1 that H maps x0 to, in pixels; infinite on its horizon.

    Args:
        H: homographies (..., 3, 3), of any scale and sign.
        x0: points in image 0, (..., N, 2), px.

    Returns:
        (..., N, 2).
    """
    X, Y, W = lines_through(unit_largest(H), x0)
    seen = W != 0
    by = 1 / torch.where(seen, W, 1.0)
    return torch.where(seen[..., None], torch.stack([X * by, Y * by], -1), torch.inf)


def homography_transfer(H: Matrix, x0: Points, x1: Points) -> tuple[PerMatch, PerMatch]:
    """Transfer distances in pixels: from ``H^-1 x1`` to x0 in image 0, from ``H x0`` to x1 in image 1.

    Infinite on a horizon, and in image 0 where H is singular. Their squares add up to the symmetric transfer error
    (Hartley & Zisserman, eq. 4.7).

    Args:
        H: homographies (..., 3, 3), of any scale and sign.
        x0: points in image 0, (..., N, 2), px.
        x1: their matches in image 1, (..., N, 2), px.

    Returns:
        Two tensors (..., N), at least 0: in image 0, in image 1.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import homography_transfer
        >>> H = torch.diag(torch.tensor([2.0, 2.0, 1.0]))
        >>> [float(d) for d in homography_transfer(H, torch.tensor([[10.0, 20.0]]), torch.tensor([[20.0, 46.0]]))]
        [3.0, 6.0]
    """
    adjugate = cofactors(unit_largest(H).movedim((-2, -1), (0, 1))).movedim((0, 1), (-1, -2))
    return _distance(homography_points(adjugate, x1), x0), _distance(homography_points(H, x0), x1)


def homography_sampson(H: Matrix, x0: Points, x1: Points) -> PerMatch:
    """Sampson distance of a homography in pixels: of both images together (Hartley & Zisserman, section 4.2.6).
    The length of the least correction of x0 and x1 that makes ``x1 ~ H x0`` hold to first order: of small errors the
    distance to the nearest exact match. Arguments as of `homography_transfer`, (..., N)."""
    h = unit_largest(H.to(torch.float64)).flatten(-2).movedim(-1, 0)[..., None]
    shape = np.broadcast_shapes(x0.shape, x1.shape)
    points = torch.cat([x0.expand(shape), x1.expand(shape)], -1).movedim(-1, 0)
    squared = linearise_homography(h, points.to(torch.float64)).squared  # of the fourth degree in the coordinates
    return (squared * inverse_root(squared)).to(x0.dtype)


def _distance(x: Tensor, y: Tensor) -> Tensor:
    """Between points (..., N, 2); a distance of zero has gradient zero."""
    apart = torch.isfinite(x).all(-1)
    dx, dy = torch.where(apart[..., None], x - y, 0.0).unbind(-1)
    squared = dx * dx + dy * dy
    return torch.where(apart, squared * inverse_root(squared), torch.inf)


def _normal_matrix(x0: Tensor, x1: Tensor, w: Tensor) -> Float[Tensor, "*batch 9 9"]:
    """The sum of w a a^T over both rows (0, -h, y1 h) and (h, 0, -x1 h) that a match gives, h its point of image 0."""
    h = torch.cat([x0, torch.ones_like(x0[..., :1])], -1).mT  # (*batch, 3, n)
    products = h[..., :, None, :] * (w[..., None, :] * h)[..., None, :, :]
    x, y = (c[..., None, None, :] for c in x1.unbind(-1))
    S, X, Y, R = (stable_sum(products * by, -1) for by in (torch.ones_like(x), -x, -y, x * x + y * y))
    zero = torch.zeros_like(S)
    return torch.cat([torch.cat(row, -1) for row in ((S, zero, X), (zero, S, Y), (X, Y, R))], -2)


# Homographies of four matches each, compiled: the samples of one pair, LANES at a time, float64, models in float32

ROUNDING = 16 * EPS  # of the area of three points on a line, relative to their coordinates and distances
SIZE = 4


@kernel
def four_point(points: F8x2, sample: I8x2, H: F4x2, draw: I8x1) -> int:
    """Homographies of samples (4, s) of points (4, n) -> H (s, 9), draw (s,), their samples; how many there are.
    points: rows x0, y0, x1, y1, of about unit scale. H: of unit norm, positive in the third coordinate of H x0 at the
    points of the sample. A sample gives none if three of its points lie on a line in either image, or if one of the
    four triangles is turned over between the images: then the points would lie on both sides of the plane's horizon, or
    the plane would be seen from behind."""
    X, h, there = matrix(4 * SIZE, LANES), np.empty((1, 9, LANES)), np.empty((1, LANES), np.bool_)
    work, models = matrix(6, LANES), 0
    for first in range(0, sample.shape[1], LANES):
        gather(points, sample, first, X)
        store(there, 0, _homographies(X, work, h[0]))
        models = add_models(h, there, first, H, draw, models, sample.shape[1])
    return models


@inner
def _homographies(X: Array, work: Array, h: Array) -> Any:
    """Of LANES samples X (16, LANES) -> h (9, LANES); a mask, which there are. work: (6, LANES)."""
    there = fill(0.0) == 0.0
    for image in range(2):
        there &= _areas(X, 2 * image, work, 3 * image)
    rows = fill(0.0)
    h00, h01, h10, h11, h20, h21 = rows, rows, rows, rows, rows, rows
    x3, y3, u3, v3 = load(X, 12), load(X, 13), load(X, 14), load(X, 15)
    D, E = rows, rows
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        d, e = load(work, i), load(work, 3 + i)
        there &= d * e > 0.0
        ratio = e / d
        p, q = ratio * (load(X, 4 * j + 1) - load(X, 4 * k + 1)), ratio * (load(X, 4 * k) - load(X, 4 * j))
        u, v = load(X, 4 * i + 2) - u3, load(X, 4 * i + 3) - v3
        h00, h01 = h00 + u * p, h01 + u * q
        h10, h11 = h10 + v * p, h11 + v * q
        h20, h21 = h20 + p, h21 + q
        D, E = D + d, E + e
    there &= D * E > 0.0
    # From where the fourth match is the origin to where it was; positive at the fourth point of image 0.
    h00, h01, h10, h11 = h00 + u3 * h20, h01 + u3 * h21, h10 + v3 * h20, h11 + v3 * h21
    h02, h12, h22 = u3 * E - h00 * x3 - h01 * y3, v3 * E - h10 * x3 - h11 * y3, E - h20 * x3 - h21 * y3
    size = sqrt(
        h00 * h00 + h01 * h01 + h02 * h02 + h10 * h10 + h11 * h11 + h12 * h12 + h20 * h20 + h21 * h21 + h22 * h22
    )
    by = 1.0 / where(E > 0.0, size, 0.0 - size)
    store(h, 0, (h00 * by, h01 * by, h02 * by, h10 * by, h11 * by, h12 * by, h20 * by, h21 * by, h22 * by))
    return there & (size > 0.0) & (size < math.inf)


@inner
def _areas(X: Array, x: int, work: Array, out: int) -> Any:
    """D_1, D_2, D_3 of points X (16, LANES), whose x of the image are in row x -> rows of work from `out` on.
    A mask: whether no three of the four points lie on a line, up to rounding."""
    x3, y3 = load(X, 12 + x), load(X, 13 + x)
    largest = where(absolute(x3) > absolute(y3), absolute(x3), absolute(y3))
    longest, total = fill(0.0), fill(0.0)
    for i in range(3):
        j, k = 4 * ((i + 1) % 3) + x, 4 * ((i + 2) % 3) + x
        xj, yj, xk, yk = load(X, j), load(X, j + 1), load(X, k), load(X, k + 1)
        area = (xj - x3) * (yk - y3) - (xk - x3) * (yj - y3)
        store(work, out + i, area)
        total += area
        largest = where(absolute(xj) > largest, absolute(xj), largest)
        largest = where(absolute(yj) > largest, absolute(yj), largest)
        longest = where(absolute(xj - x3) > longest, absolute(xj - x3), longest)
        longest = where(absolute(yj - y3) > longest, absolute(yj - y3), longest)
    smallest = ROUNDING * largest * longest
    apart = absolute(total) > smallest
    for i in range(3):
        apart &= absolute(load(work, out + i)) > smallest
    return apart


# Homographies and the planes they stand for: ``x1 ~ H x0``. Matrices are (9,), row by row, points (4, n), float64


@inner
def in_pixels(H: Array, centre: Array, unit_px: float, out: Array) -> None:
    """A homography of points about centres (4,), in units of so many pixels, as that of pixels -> out (9,)."""
    for r in range(3):
        out[3 * r], out[3 * r + 1] = H[3 * r] / unit_px, H[3 * r + 1] / unit_px
        out[3 * r + 2] = H[3 * r + 2] - out[3 * r] * centre[0] - out[3 * r + 1] * centre[1]
    for c in range(3):
        out[c] = unit_px * out[c] + centre[2] * out[6 + c]
        out[3 + c] = unit_px * out[3 + c] + centre[3] * out[6 + c]


@inner
def adjugate(H: Array, A: Array) -> None:
    """A multiple of the inverse of H -> A: the transposed cofactors."""
    A[0], A[1], A[2] = H[4] * H[8] - H[5] * H[7], H[7] * H[2] - H[8] * H[1], H[1] * H[5] - H[2] * H[4]
    A[3], A[4], A[5] = H[5] * H[6] - H[3] * H[8], H[8] * H[0] - H[6] * H[2], H[2] * H[3] - H[0] * H[5]
    A[6], A[7], A[8] = H[3] * H[7] - H[4] * H[6], H[6] * H[1] - H[7] * H[0], H[0] * H[4] - H[1] * H[3]


@inner
def maps(H: Array, x: float, y: float, u: float, v: float, limit: float) -> Any:
    """Whether H maps (x, y) to within a squared distance of (u, v)."""
    depth = H[6] * x + H[7] * y + H[8]
    du = (H[0] * x + H[1] * y + H[2]) / depth - u
    dv = (H[3] * x + H[4] * y + H[5]) / depth - v
    return du * du + dv * dv <= limit


@inner
def near_plane(H: Array, points: Array, limit: float, out: Array) -> int:
    """Which matches H and its inverse map to within a squared distance of each other -> out (n,); how many."""
    A, count = vector(9), 0
    adjugate(H, A)
    x0, y0, x1, y1 = points[0], points[1], points[2], points[3]
    for i in range(len(out)):
        out[i] = maps(H, x0[i], y0[i], x1[i], y1[i], limit) and maps(A, x1[i], y1[i], x0[i], y0[i], limit)
        count += out[i]
    return count


@inner
def cross_times(e: Array, A: Array, out: Array) -> None:
    """``[e]_x A`` -> out."""
    for c in range(3):
        p, q, r = A[c], A[3 + c], A[6 + c]
        out[c], out[3 + c], out[6 + c] = e[1] * r - e[2] * q, e[2] * p - e[0] * r, e[0] * q - e[1] * p


@inner
def plane_homography(F: Array, e1: Array, points: Array, triplet: Array, H: Array) -> bool:
    """The homography of the plane through the matches (3,) of a triplet that satisfy F -> H; if it is determined.
    ``H = A - e1 (M^-1 b)^T`` with ``A = [e1]_x F``, the rows of M the points in image 0, and
    ``b_i = (x1_i x (A x0_i)) . (x1_i x e1) / |x1_i x e1|^2`` (result 13.6); ``F^T e1 = 0``, the epipole of image 1."""
    A, b, M = vector(9), vector(3), matrix(3, 3)
    cross_times(e1, F, A)
    for k in range(3):
        i = triplet[k]
        x0, y0, x1, y1 = points[0, i], points[1, i], points[2, i], points[3, i]
        M[k, 0], M[k, 1], M[k, 2] = x0, y0, 1.0
        p, q, r = A[0] * x0 + A[1] * y0 + A[2], A[3] * x0 + A[4] * y0 + A[5], A[6] * x0 + A[7] * y0 + A[8]
        cx, cy, cz = y1 * e1[2] - e1[1], e1[0] - x1 * e1[2], x1 * e1[1] - y1 * e1[0]
        length2 = cx * cx + cy * cy + cz * cz
        if not length2 > 0:
            return False
        b[k] = ((y1 * r - q) * cx + (p - x1 * r) * cy + (x1 * q - y1 * p) * cz) / length2
    determinant, v = 0.0, vector(3)
    for c in range(3):  # Cramer's rule
        d, e = (c + 1) % 3, (c + 2) % 3
        qr, rp = M[1, d] * M[2, e] - M[1, e] * M[2, d], M[2, d] * M[0, e] - M[2, e] * M[0, d]
        pq = M[0, d] * M[1, e] - M[0, e] * M[1, d]
        determinant += M[0, c] * qr
        v[c] = b[0] * qr + b[1] * rp + b[2] * pq
    if determinant == 0:
        return False
    for r in range(3):
        for c in range(3):
            H[3 * r + c] = A[3 * r + c] - e1[r] * (v[c] / determinant)
    return True


@inner
def plane_and_parallax(H: Array, points: Array, i: int, j: int, F: Array) -> bool:
    """The fundamental matrix of a plane's homography and matches i and j off it -> F, of unit norm; if there is one.
    ``F = [e1]_x H``: the lines through x1 and H x0 of both matches meet in the epipole e1 (section 13.2)."""
    lines, e, size2 = matrix(2, 3), vector(3), 0.0
    for k in range(9):
        size2 += H[k] * H[k]
    for k in range(2):
        n = i if k == 0 else j
        x0, y0, x1, y1 = points[0, n], points[1, n], points[2, n], points[3, n]
        p, q, r = H[0] * x0 + H[1] * y0 + H[2], H[3] * x0 + H[4] * y0 + H[5], H[6] * x0 + H[7] * y0 + H[8]
        lines[k, 0], lines[k, 1], lines[k, 2] = y1 * r - q, p - x1 * r, x1 * q - y1 * p
        size2 *= lines[k, 0] * lines[k, 0] + lines[k, 1] * lines[k, 1] + lines[k, 2] * lines[k, 2]
    for c in range(3):
        d, f = (c + 1) % 3, (c + 2) % 3
        e[c] = lines[0, d] * lines[1, f] - lines[0, f] * lines[1, d]
    cross_times(e, H, F)
    norm2 = 0.0
    for k in range(9):
        norm2 += F[k] * F[k]
    if not (norm2 > ROUNDING * ROUNDING * size2 and math.isfinite(norm2)):
        return False
    norm = math.sqrt(norm2)
    for k in range(9):
        F[k] /= norm
    return True


@inner
def least_squares_homography(points: Array, weight: Array, H: Array) -> bool:
    """The normalised DLT of matches (n,) by their weights, or of those inside -> H; whether it is determined.
    Hartley & Zisserman (2004), algorithm 4.2."""
    T, S, M = matrix(2, 3), np.zeros((4, 3, 3)), np.zeros((9, 9))
    for image in range(2):
        if not _similarity(points[2 * image], points[2 * image + 1], weight, T[image]):
            return False
    s0, s1, h = T[0, 0], T[1, 0], np.ones(3)
    for i in range(len(weight)):
        if weight[i] > 0:
            h[0], h[1] = (points[0, i] - T[0, 1]) * s0, (points[1, i] - T[0, 2]) * s0
            x, y = (points[2, i] - T[1, 1]) * s1, (points[3, i] - T[1, 2]) * s1
            for r in range(3):
                for c in range(r, 3):
                    product = h[r] * h[c] * (1.0 * weight[i])
                    S[0, r, c] += product
                    S[1, r, c] -= x * product
                    S[2, r, c] -= y * product
                    S[3, r, c] += (x * x + y * y) * product
    for r in range(3):  # the sums of both rows that a match gives, (0, -h, y h) and (h, 0, -x h)
        for c in range(3):
            a, b = min(r, c), max(r, c)
            M[r, c] = M[3 + r, 3 + c] = S[0, a, b]
            M[r, 6 + c] = M[6 + r, c] = S[1, a, b]
            M[3 + r, 6 + c] = M[6 + r, 3 + c] = S[2, a, b]
            M[6 + r, 6 + c] = S[3, a, b]
    if not smallest_eigenvector_kernel(M, H):
        return False
    for r in range(3):  # H T0
        H[3 * r], H[3 * r + 1] = H[3 * r] * s0, H[3 * r + 1] * s0
        H[3 * r + 2] -= H[3 * r] * T[0, 1] + H[3 * r + 1] * T[0, 2]
    for c in range(3):  # the adjugate of T1, times that
        last = s1 * s1 * H[6 + c]
        H[c], H[3 + c], H[6 + c] = s1 * H[c] + T[1, 1] * last, s1 * H[3 + c] + T[1, 2] * last, last
    return True


@inner
def _similarity(x: Array, y: Array, weight: Array, out: Array) -> bool:
    """Scale and centre of the points of weight, as of `normalize_points` -> out (3,); False where there are none."""
    count, cx, cy, distance = 0, 0.0, 0.0, 0.0
    for i in range(len(weight)):
        if weight[i] > 0:
            count += 1
            cx += x[i]
            cy += y[i]
    if count == 0:
        return False
    cx, cy = cx / count, cy / count
    for i in range(len(weight)):
        if weight[i] > 0:
            distance += math.sqrt((x[i] - cx) * (x[i] - cx) + (y[i] - cy) * (y[i] - cy))
    distance /= count
    out[0] = 2**0.5 / distance if distance > 4 * EPS * max(abs(cx), abs(cy)) else 1.0
    out[1], out[2] = cx, cy
    return True


@kernel
def weighted_homography(points: F8x2, weight: F8x1, H: F8x1) -> bool:
    """`least_squares_homography`, positive at most of the weight -> H (9,); whether it is determined."""
    if not least_squares_homography(points, weight, H):
        return False
    front, total = 0.0, 0.0
    for i in range(len(weight)):
        total += weight[i]
        front += weight[i] if H[6] * points[0, i] + H[7] * points[1, i] + H[8] > 0 else 0.0
    for q in range(9):
        H[q] = -H[q] if 2 * front < total else H[q]
    unit_kernel(H)
    return True
