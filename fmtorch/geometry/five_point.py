"""The five-point algorithm: essential matrices of five matches of calibrated cameras, over many samples at once.

Nister, "An efficient solution to the five-point relative pose problem" (PAMI 2004). Real roots of the polynomial of
degree ten are those across which it changes its sign between the points of a grid, so that a sample costs element-wise
operations alone and its results have the same bits whatever stands beside it.
"""

from __future__ import annotations

import functools
import itertools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, cross, sqrt
from fmtorch.geometry.nullspace import null_space

GRID = 64  # intervals of the projective line in which a root is looked for
POLISHING_STEPS = 4  # of Newton's method, from the secant through the ends of the interval

# E = x X + y Y + z Z + W; a monomial is a sorted triple of 0 to 3 for x, y, z, 1, in the order of the paper.
_MONOMIALS = (
    "000", "111", "001", "011", "002", "003", "112", "113", "012", "013",
    "022", "023", "033", "122", "123", "133", "222", "223", "233", "333",
)  # fmt: skip
_PAIRS = tuple(itertools.combinations_with_replacement(range(4), 2))


def five_point_components(points: Float[Tensor, " 4 5 s"]) -> tuple[Float[Tensor, "9 r"], Int[Tensor, " r"]]:
    """Essential matrices of five correspondences in calibrated coordinates, and of which sample each one is.

    points: x0, y0, x1, y1 of rays (x, y, 1), float64. E: row by row, unit Frobenius norm, in the order of the samples;
    up to ten of a sample, 4.3 on average: two roots within one interval of the grid are not found, which are a tenth
    of all. Samples that are degenerate or not finite have none.
    """
    finite = points.abs().amax((0, 1)).isfinite()
    points = points.nan_to_num(0.0, 0.0, 0.0)
    x0, y0, x1, y1 = points
    rows = torch.stack([x1 * x0, x1 * y0, x1, y1 * x0, y1 * y0, y1, x0, y0, torch.ones_like(x0)], 1)
    basis, full_rank = null_space(rows)
    B, regular = _eliminated(_constraints(basis.reshape(4, 3, 3, -1)))
    return _solutions(basis, B, finite & full_rank & regular)


@functools.cache
def _tables(device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Where the terms of quadratic forms stand among the 16 products of two of x, y, z, 1, and their factor.

    And where those of the cubic ones stand among the 40 of a quadratic and a linear one, three at most, 40 for none.
    """
    first = torch.tensor([4 * a + b for a, b in _PAIRS], device=device)
    second = torch.tensor([4 * b + a for a, b in _PAIRS], device=device)
    factor = torch.tensor([0.5 if a == b else 1.0 for a, b in _PAIRS], dtype=torch.float64, device=device)
    terms = [
        [4 * i + c for i, (a, b) in enumerate(_PAIRS) for c in range(4) if sorted((a, b, c)) == [int(v) for v in m]]
        for m in _MONOMIALS
    ]
    cubic = torch.tensor([[t[i] if i < len(t) else 40 for t in terms] for i in range(3)], device=device)
    return first, second, factor, cubic, torch.tensor([0, 4, 8], device=device)


def _constraints(e: Float[Tensor, "4 3 3 s"]) -> Float[Tensor, "10 20 s"]:
    """The coefficients of ``det E = 0`` and ``E E^T E - tr(E E^T) E / 2 = 0`` in the twenty monomials."""
    first, second, factor, (one, two, three), diagonal = _tables(e.device)
    s = e.shape[-1]

    def quadratic(products: Tensor) -> Tensor:
        """(16, m, s) products of two basis matrices as the ten coefficients of a quadratic form."""
        both = products.index_select(0, first) + products.index_select(0, second)
        return both.mul_(factor[:, None, None])

    # (a, b, i, j): sum over k of e_a[i, k] e_b[j, k]; then minus half its trace.
    left, right = e[:, None, :, None], e[None, :, None]
    gram = left[..., 0, :] * right[..., 0, :]
    gram.addcmul_(left[..., 1, :], right[..., 1, :]).addcmul_(left[..., 2, :], right[..., 2, :])
    quadrics = quadratic(gram.view(16, 9, s))
    half_trace = (quadrics[:, 0] + quadrics[:, 4] + quadrics[:, 8]) / 2
    quadrics.index_add_(1, diagonal, half_trace[:, None].expand(-1, 3, -1), alpha=-1)
    r0, r1, r2 = e.unbind(1)
    minors = torch.stack(
        [r1[:, None, i] * r2[None, :, j] - r1[:, None, j] * r2[None, :, i] for i, j in ((1, 2), (2, 0), (0, 1))], 2
    )
    minors = quadratic(minors.view(16, 3, s))
    # Terms of quadratic forms times entries of E: first those of the determinant, then of the nine other equations.
    Q = quadrics.view(10, 1, 3, 3, s)
    terms = e.new_zeros(41, 10, s)
    nine = terms[:40, 1:].view(10, 4, 9, s).view(10, 4, 3, 3, s)
    torch.mul(Q[..., 0, None, :], e[:, None, 0], out=nine)
    nine.addcmul_(Q[..., 1, None, :], e[:, None, 1]).addcmul_(Q[..., 2, None, :], e[:, None, 2])
    determinant = terms[:40, 0].view(10, 4, s)
    torch.mul(minors[:, None, 0], r0[:, 0], out=determinant)
    determinant.addcmul_(minors[:, None, 1], r0[:, 1]).addcmul_(minors[:, None, 2], r0[:, 2])
    cubics = terms.index_select(0, one).add_(terms.index_select(0, two)).add_(terms.index_select(0, three))
    return cubics.transpose(0, 1)


def _eliminated(A: Float[Tensor, "10 20 s"]) -> tuple[Float[Tensor, "3 3 5 s"], Bool[Tensor, " s"]]:
    """The 3 x 3 matrix of polynomials in z that (x, y, 1) is the null vector of, and whether elimination went well.

    Gauss elimination, carried out for the last six of the ten leading monomials; then z times the equation of x^2 is
    subtracted from that of x^2 z, and so on. Without pivoting: the coefficients are generic. Polynomials have the
    highest power first.
    """
    rows: list[Tensor] = []
    for _ in range(10):
        row = A[0, 1:] / A[0, 0]
        rows.append(row)
        A = torch.addcmul(A[1:, 1:], A[1:, :1], row, value=-1)
    reduced: list[Tensor] = []  # of the monomials 9, 8, ..., 4: the coefficients of the ten others
    for k in range(9, 3, -1):
        row, between = rows[k][-10:], rows[k][:-10]
        for i, done in enumerate(reduced):
            row = torch.addcmul(row, between[8 - k - i], done, value=-1)
        reduced.append(row)
    xy, xyz, y2, y2z, x2, x2z = reduced
    a, b = torch.stack([x2z, y2z, xyz]), torch.stack([x2, y2, xy])
    B = a.new_zeros(3, 3, 5, *a.shape[2:])
    for column, (first, count) in enumerate(((0, 3), (3, 3), (6, 4))):
        B[:, column, 5 - count :] += a[:, first : first + count]
        B[:, column, 4 - count : 4] -= b[:, first : first + count]
    return B, B.isfinite().flatten(0, 2).all(0)


def _times(a: Float[Tensor, "m s"], b: Float[Tensor, "n s"]) -> Float[Tensor, "m_n s"]:
    """The product of two polynomials."""
    product = a.new_zeros(len(a) + len(b) - 1, *a.shape[1:])
    for i in range(len(a)):
        product[i : i + len(b)].addcmul_(a[i], b)
    return product


def _determinant(B: Float[Tensor, "3 3 5 s"]) -> Float[Tensor, "11 s"]:
    """Of polynomials of degrees 3, 3 and 4 in each row."""
    (a, b, c), (d, e, f), (g, h, i) = ((row[0, 1:], row[1, 1:], row[2]) for row in B.unbind(0))
    return (
        _times(_times(b, f) - _times(c, e), g)
        + _times(_times(c, d) - _times(a, f), h)
        + _times(_times(a, e) - _times(b, d), i)
    )


def _solutions(
    basis: Float[Tensor, "4 9 s"], B: Float[Tensor, "3 3 5 s"], valid: Bool[Tensor, " s"]
) -> tuple[Float[Tensor, "9 r"], Int[Tensor, " r"]]:
    p = _determinant(B)
    size = p.abs().amax(0)
    valid = valid & size.isfinite() & (size > 0)
    p = torch.where(valid, p, 0.0) / torch.where(valid, size, 1.0)
    # The projective line in two charts, z from -1 to 1 and 1 / z from 1 down to -1: the degree is even, so signs fit.
    knots = torch.arange(GRID // 2 + 1, dtype=p.dtype, device=p.device) / (GRID // 4) - 1
    knots = torch.stack([knots, knots.flip(0)])
    charts = torch.stack([p, p.flip(0)], 1)
    values = _horner(charts[:, :, None], knots[:, :, None])
    negative = values < 0
    sample, chart, interval = ((negative[:, :-1] != negative[:, 1:]) & valid).permute(2, 0, 1).nonzero(as_tuple=True)
    low, high = ((knots[chart, interval + k], values[chart, interval + k, sample]) for k in (0, 1))
    z = _polished(charts[:, chart, sample], *low, *high)
    far = chart == 1
    M = B.flatten(0, 1).transpose(0, 1).index_select(2, sample)
    m = _horner(torch.where(far, M.flip(0), M), z).view(3, 3, -1)
    x, y, one = _null_vector(m)
    # x : y : z : 1 of the root; with u = 1 / z for z the polynomials were divided by z^4, and x : y : 1 is (x, y, one).
    weights = torch.stack(
        [
            torch.where(far, x * z, x),
            torch.where(far, y * z, y),
            torch.where(far, one, one * z),
            torch.where(far, one * z, one),
        ]
    )
    E = component_sum(basis.index_select(2, sample) * weights[:, None])
    norm = sqrt(component_sum(E * E))
    valid = norm.isfinite() & (norm > 0)
    return (E / norm)[:, valid], sample[valid]


def _horner(p: Float[Tensor, c * s], z: Tensor) -> Tensor:
    """The polynomial at z."""
    value = torch.addcmul(p[1], p[0], z)
    for c in p[2:]:
        value = torch.addcmul(c, value, z)
    return value


def _polished(p: Float[Tensor, "11 r"], low: Tensor, v_low: Tensor, high: Tensor, v_high: Tensor) -> Tensor:
    """The root between two places of different sign: Newton's method, where it leaves the interval bisection."""
    z = low - v_low * (high - low) / (v_high - v_low)
    rising = v_low < 0
    for _ in range(POLISHING_STEPS):
        slope, value = p[0], torch.addcmul(p[1], p[0], z)
        for c in p[2:]:
            slope = torch.addcmul(value, slope, z)
            value = torch.addcmul(c, value, z)
        same = (value < 0) == rising
        low, high = torch.where(same, z, low), torch.where(same, high, z)
        step = z - value / slope
        inside = (step >= torch.minimum(low, high)) & (step <= torch.maximum(low, high))
        z = torch.where(inside, step, (low + high) / 2)
    return z


def _null_vector(m: Float[Tensor, "3 3 r"]) -> tuple[Tensor, Tensor, Tensor]:
    """The longest cross product of two rows."""
    candidates = torch.stack([cross(m[i], m[j]) for i, j in ((0, 1), (1, 2), (2, 0))])
    longest = component_sum(candidates * candidates, 1).argmax(0)
    x, y, one = candidates.gather(0, longest.expand(1, 3, -1))[0]
    return x, y, one
