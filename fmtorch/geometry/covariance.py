"""Covariance of a two-view estimate: of its pose, its focal lengths, its lenses and its fundamental matrix.

The parameters of a pair are (omega, tau, log f0, log f1, lambda0, lambda1): R is ``exp([omega]x) R``, the direction of
translation moves along two unit tangents, ``t + B tau``, so that both are in radians; lambda is of the division model.
The information of a fit that minimises the robust sum of w rho(r^2) with a loss truncated at T is J^T W J over the
matches within T, J being the derivative of the Sampson distance in the photograph (Hartley & Zisserman 2004, 11.4.3),
with five corrections:

1. A truncated fit does not use all that its inliers know: its variance is E[psi^2] / E[psi']^2 of that of one match
   (Huber 1981, Robust Statistics, chapter 7). With c = T / s, A = P(|z| < c) and m = A - 2 c phi(c), which both
   expectations are for the truncated square, the information is m / A of J^T W J.
2. The noise s is estimated anew from the distances below 2.5 s, consistent at normal noise: the scale of a robust fit
   is biased by its own limits and by the parameters that were fitted.
3. The derivatives by t hold noise, as if it were parallax, also once all that rotations and focal lengths explain is
   taken from them: what is seen, S, is more than what there is, T, by the expected information N of noise alone. The
   direction of translation is then known to ``T^-1 S T^-1`` (measurement error: Fuller 1987, section 2.2; the bias of
   matrices of moments: Kanatani 1996, Statistical Optimization for Geometric Computation, chapter 9). Without that a
   camera that only turns seems to have a direction, known to some ten degrees. Where a rotation explains the matches
   up to their noise, nothing is left.
4. Where neighbours err alike, as in dense matches, so many tell less: see `noise_inflation`.
5. Where there is little parallax, a wrong match beside its epipolar line has a hundred times as much and would decide
   the direction of translation alone: matches with `OUTLYING` times what most have tell nothing.

Weights that are no inverse variances, such as P(inlier), count by ``sum w / sum w^2`` (Kish 1965)."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors, component_sum, cross, determinant, product, sqrt, stable_sum
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.matrices import complement
from fmtorch.jit.kernel import F8x1, F8x2, for_each_pair, kernel

PINHOLES, PARAMETERS = 7, 9  # without and with two lenses
WINDOW = 2.5  # noises within which distances are taken to be those of right matches
WINDOW_SHARE = 0.911256360935392  # `kept_share` of WINDOW
ITERATIONS = 8  # of the noise; each leaves a quarter of the error (by the slope of `kept_share` at WINDOW)
MIN_NOISE_PX = 1e-3  # float32 coordinates of large images are no finer
MIN_SPARE_MATCHES = 3  # beyond the parameters, from which on the noise is estimated
ROTATION_STEPS, ROTATION_SCALE = 6, 9.0  # of the fit of a rotation, and of its loss (Cauchy's), in variances
CHI_MEDIAN, MEDIAN_DEVIATION = 1.3862943611198906, 1.4426950408889634  # of chi squared of two degrees, ln 4; relative,
MEDIAN_DEVIATIONS = 4.0  # of the median of n, times sqrt(n)
MOST_STILL = 18.4  # of nine tenths of such distances, four times that of chi squared, as noise may have a long tail
OUTLYING = 4.0  # times the parallax that nine tenths of the matches do not exceed
CELLS = 24  # to the longer side of the box of matches, of a grid that tells how neighbours err
INDEPENDENT = 1.2  # inflation beyond which are 2 to 7 % of fits to 150 to 10,000 matches with independent noise
TERMS, WIDEST = 64, 6.0  # of the series of `kept_share`, and from where on it is one to 1e-7


def tangents(R: Tensor, t: Tensor, focal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """F (3, 3, b) between centred pixels, its derivatives by the parameters (3, 3, 7, b), and the basis (3, 2, b)."""
    basis = torch.stack(complement(t), 1)
    E = cross(t[:, None].expand_as(R), R)
    axes = torch.eye(3, dtype=R.dtype, device=R.device)[..., None].expand(3, 3, R.shape[-1])
    spun = (cross(axes[k][:, None].expand_as(R), R) for k in range(3))
    turned = [cross(t[:, None].expand_as(R), A) for A in spun]
    shifted = [cross(basis[:, k, None].expand_as(R), R) for k in range(2)]
    scale0, scale1 = (torch.stack([1 / f, 1 / f, torch.ones_like(f)]) for f in focal)
    by0, by1 = (torch.stack([-1 / f, -1 / f, torch.zeros_like(f)]) for f in focal)
    pixels = scale1[:, None] * scale0[None]
    scaled = [A * pixels for A in (*turned, *shifted)]
    slopes = torch.stack([*scaled, E * scale1[:, None] * by0[None], E * by1[:, None] * scale0[None]], 2)
    return E * pixels, slopes, basis


def lifted(a: Tensor, bend: Tensor) -> Tensor:
    """Homogeneous points (3, b, n) of pinholes from those (2, b, n) that lenses bend; bend: (b, 1), lambda by px^2."""
    return torch.cat([a, 1 + bend * component_sum(a * a)[None]])


def residual_slopes(
    F: Tensor, slopes: Tensor, a0: Tensor, a1: Tensor, bend0: Tensor, bend1: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Signed Sampson distances (b, n), their derivatives (9, b, n) by the parameters, and the noise in two of these.
    With h = (a, 1 + bend |a|^2), e = h1^T F h0 and q the sum of the squares of its derivatives by both points, r = e /
    sqrt(q), and ``dr = de / sqrt(q)`` at the points corrected to first order, where e is zero; those by the lenses are
    by their bend. Zero where a point is the epipole. The last are the covariances (2, 2, b, n) of the derivatives by
    the direction of translation, in squared noises of a point: where the images have no parallax these derivatives are
    nothing but noise, in the three directions that are not corrected."""
    h0, h1 = lifted(a0, bend0), lifted(a1, bend1)
    line1, line0 = component_sum(F[..., None] * h0[None], 1), component_sum(F[..., None] * h1[:, None], 0)
    normal = torch.cat([line0[:2] + 2 * bend0 * a0 * line0[2], line1[:2] + 2 * bend1 * a1 * line1[2]])
    root = inverse_root(component_sum(normal[2:] * normal[2:]) + component_sum(normal[:2] * normal[:2]))
    r = component_sum(h1 * line1) * root
    normal = normal * root
    a0, a1 = a0 - r * normal[:2], a1 - r * normal[2:]
    h0, h1 = lifted(a0, bend0), lifted(a1, bend1)
    by_entry = h1[:, None] * h0[None] * root
    J = component_sum((by_entry[:, :, None] * slopes[..., None]).flatten(0, 1))
    by_depth = torch.stack([component_sum(F[:, 2, :, None] * h1), component_sum(F[2, ..., None] * h0)]) * root
    J = torch.cat([J, by_depth * torch.stack([component_sum(a0 * a0), component_sum(a1 * a1)])])
    shifted = slopes[:, :, 3:5, :, None]
    by_h0, by_h1 = component_sum(shifted * h1[:, None, None], 0), component_sum(shifted * h0[None, :, None], 1)
    bent0, bent1 = 2 * bend0 * a0[:, None] * by_h0[2], 2 * bend1 * a1[:, None] * by_h1[2]
    by_point = torch.cat([by_h0[:2] + bent0, by_h1[:2] + bent1]) * root
    corrected = component_sum(normal[:, None] * by_point)
    noise = component_sum(by_point[:, :, None] * by_point[:, None]) - corrected[:, None] * corrected[None]
    return r, J, noise


def beside_rotation(a0: Tensor, a1: Tensor, R: Tensor, f: Tensor, s: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """How far points (2, b, n) are from where a rotation near R (3, 3, b) turns them, over that of the ninth tenth (b,
    n), and whether they are there up to their noise s (b, n): (b,). The rotation is fitted to the matches `near` (b,
    n), robustly; then half of its squared distances, in units of their variance 2 s^2, are below the median of chi
    squared of two degrees, ln 4, as far as so many tell it, and nine tenths below `MOST_STILL`."""
    ones, count = torch.ones_like(a0[:1]), near.sum(-1)
    rays = torch.cat([a0 / f[0, :, None], ones])
    target = a1 / f[1, :, None]
    scale = (s / f[1, :, None]).clamp_min(1e-300)
    weight = near.to(a0.dtype)
    turned = component_sum(R[:, :, :, None] * rays[None], 1)
    squared = torch.zeros_like(scale)
    for step in range(ROTATION_STEPS):
        x, y, z = turned
        u, v = x / z, y / z
        e0, e1 = target[0] - u, target[1] - v
        squared = (e0 * e0 + e1 * e1) / (2 * scale * scale)
        if step == ROTATION_STEPS - 1:
            break
        # of the projections of a ray that is turned by omega
        J0, J1 = torch.stack([-u * v, 1 + u * u, -v]), torch.stack([-(1 + v * v), u * v, u])
        by = torch.where(near, weight / (1 + squared / ROTATION_SCALE), 0.0)
        A = stable_sum((J0[:, None] * J0[None] + J1[:, None] * J1[None]) * by)
        b = stable_sum((J0 * e0 + J1 * e1) * by)
        determinant_ = determinant(A)
        omega = component_sum(cofactors(A) * b[:, None], 0) / torch.where(determinant_ == 0, 1.0, determinant_)
        turned = turned + cross(omega[..., None].expand_as(turned), turned)
    ordered = torch.where(near, squared, torch.inf).sort(-1).values
    places = (count - 1).clamp_min(0)[:, None] * torch.tensor([5, 9], device=count.device) // 10
    tenths = ordered.gather(-1, places) if ordered.shape[-1] else torch.full_like(f.T, torch.inf)
    limit = CHI_MEDIAN * (1 + MEDIAN_DEVIATIONS * MEDIAN_DEVIATION / sqrt(count.to(f).clamp_min(1)))
    parallax = sqrt(squared / tenths[:, 1:].clamp_min(CHI_MEDIAN))
    return parallax, (count > PINHOLES) & (tenths[:, 0] < limit) & (tenths[:, 1] < MOST_STILL)


def kept_share(c: Tensor) -> Tensor:
    """m / A of limits c (b,): ``1 - 1 / S``, ``S = sum_k c^2k / (2 k + 1)!!``, by the series of the normal integral."""
    square = c.clamp_max(WIDEST) * c.clamp_max(WIDEST)
    ratios = square[..., None] / torch.arange(3.0, 2 * TERMS + 3, 2, dtype=c.dtype, device=c.device)
    return 1 - 1 / (1 + component_sum(ratios.cumprod(-1), -1))


def noise_of(r: Tensor, w: Tensor, T: Tensor, parameters: Tensor) -> Tensor:
    """s (b,): ``s^2 = sum w r^2 / (share (sum w - p share sum w^2 / sum w))`` within WINDOW s, iterated from 0.6 T.
    Within a window the share m / A of the variance is left; p parameters have taken theirs of that. At most T. Without
    a limit it is started at the root mean square; of fewer matches than parameters it is not estimated."""
    # Of each match: its count, weight, squared weight, weighted square of the distance.
    summands = torch.stack([(w > 0).to(r.dtype), w, w * w, w * r * r])
    _, total, _, square = stable_sum(summands)
    start = torch.where(T.isfinite(), 0.6 * T, sqrt(square / total.clamp_min(1e-300)))
    s = start.clamp_min(MIN_NOISE_PX)
    for _ in range(ITERATIONS):
        count, total, squares, square = stable_sum(torch.where(r < WINDOW * s[:, None], summands, 0.0))
        spare = WINDOW_SHARE * (total - parameters * WINDOW_SHARE * squares / total.clamp_min(1e-300))
        enough = (count >= parameters + MIN_SPARE_MATCHES) & (spare > 0)
        estimate = sqrt(square / torch.where(spare > 0, spare, 1.0)).clamp_min(MIN_NOISE_PX)
        s = torch.where(enough, estimate.minimum(T), s)
    return s


@kernel
def noise_inflation(x: F8x2, error: F8x1, out: F8x1) -> None:
    """How much more the sums of errors (n,) vary than those of independent ones -> out (1,), 1 up to `INDEPENDENT`.

    If neighbours err alike, sums over regions have D times the variance of independent summands, and so has a fit
    (T. Conley: GMM estimation with cross sectional dependence. J. Econometrics 92, 1999). Sums over square cells of
    side L miss neighbours in the next cell: they see D (1 - a / L)^2, a being the mean offset of what errs alike along
    an axis; those over all blocks of 2 x 2 cells see D (1 - a / 2L)^2. So ``sqrt D`` is twice the root of the latter
    less that of the former; a tenth of it is missed, a fifth where Gaussian patches are as wide as half a cell.
    x: points (n, 2) of one image, any unit. Those without an error do not count."""
    left, top, right, bottom, squares = math.inf, math.inf, -math.inf, -math.inf, 0.0
    for i in range(len(error)):
        if error[i] != 0:
            left, right, top, bottom = min(left, x[i, 0]), max(right, x[i, 0]), min(top, x[i, 1]), max(bottom, x[i, 1])
            squares += error[i] * error[i]
    side = max(right - left, bottom - top) / CELLS
    out[0] = 1
    if not (squares > 0 and side > 0):
        return
    cell = np.zeros((CELLS + 2, CELLS + 2))
    for i in range(len(error)):
        if error[i] != 0:
            row, column = min(int((x[i, 1] - top) / side), CELLS - 1), min(int((x[i, 0] - left) / side), CELLS - 1)
            cell[row + 1, column + 1] += error[i]
    of_cells, of_blocks = 0.0, 0.0
    for row in range(CELLS + 1):
        for column in range(CELLS + 1):
            block = cell[row, column] + cell[row, column + 1] + cell[row + 1, column] + cell[row + 1, column + 1]
            of_cells, of_blocks = of_cells + cell[row, column] * cell[row, column], of_blocks + block * block / 4
    root = 2 * math.sqrt(of_blocks / squares) - math.sqrt(of_cells / squares)
    if root > 0 and root * root > INDEPENDENT:
        out[0] = root * root


def information_of(
    r: Tensor, J: Tensor, noise: Tensor, w: Tensor, T: Tensor, s: Tensor, inflation: Tensor
) -> tuple[Tensor, Tensor]:
    """Of the matches, (9, 9, b), and what of it noise alone gives about the direction of translation, (2, 2, b)."""
    squares = stable_sum(w * w)
    factor = kept_share(T / s) * (stable_sum(w) / torch.where(squares > 0, squares, 1.0)) / inflation
    rows, columns = torch.triu_indices(PARAMETERS, PARAMETERS, device=r.device)
    sums = stable_sum(J[rows] * J[columns] * w) * (factor / (s * s))
    index = torch.zeros_like(rows).new_zeros(PARAMETERS, PARAMETERS)
    index[rows, columns] = torch.arange(len(rows), device=r.device)
    return sums[torch.maximum(index, index.mT)], stable_sum(noise * w) * factor


DIFFUSE = (1.33, 1.33, 1.33, 1.21, 1.21, 2.3, 2.3, 0.5, 0.5)
"""Deviations that no parameter exceeds: of a rotation and a direction drawn uniformly (radians, each axis), a factor of
ten in a focal length, and of lambda. They enter as independent information, which is nothing beside that of matches."""


class LensesInPixels(NamedTuple):
    """Lenses of B pairs: ``x_u = x_d / (1 + value |x_d|^2 / half^2)`` from the principal points.
    value: lambda. half: the half diagonals, px. precision: of their prior, one over the variance, infinite where known.
    shared: where both are one parameter."""

    value: Float[Tensor, "b 2"]
    half: Float[Tensor, "b 2"]
    precision: Float[Tensor, "b 2"]
    shared: Bool[Tensor, " b"]


class TwoViewCovariance(NamedTuple):
    """Covariances of B pairs.
    covariance: of (omega, tau, log f0, log f1), radians and logarithms, and both lambdas if lenses are given; rows of
    what is known are zero. tangent: the basis B of the plane across t. fundamental: covariance of F, row by row, at
    unit Frobenius norm, in pixels. noise: s, px. valid: False where R, t, a focal length, the truncation or the prior
    is not finite or has no meaning; such a pair is as one without matches."""

    covariance: Float[Tensor, "b m m"]
    tangent: Float[Tensor, "b 3 2"]
    fundamental: Float[Tensor, "b 9 9"]
    noise: Float[Tensor, " b"]
    valid: Bool[Tensor, " b"]

    @property
    def deviation_degrees(self) -> Float[Tensor, "b 2"]:
        """Root mean squared angles of rotation and of the direction of translation, in degrees.
        Where nothing is known of them they are some 132 and 98 degrees."""
        variances = self.covariance.diagonal(dim1=-2, dim2=-1)
        turned, shifted = component_sum(variances[:, :3], -1), component_sum(variances[:, 3:5], -1)
        return torch.rad2deg(sqrt(torch.stack([turned, shifted], -1)))


def two_view_covariance(
    x0: Float[Tensor, "b n 2"], x1: Float[Tensor, "b n 2"], R: Float[Tensor, "b 3 3"], t: Float[Tensor, "b 3"],
    focal: Float[Tensor, "b 2"], principal0: Float[Tensor, "b 2"], principal1: Float[Tensor, "b 2"],
    truncation: Float[Tensor, " b"], weight: Float[Tensor, "b n"] | None = None,
    noise: Float[Tensor, "b n"] | None = None, mask: Bool[Tensor, "b n"] | None = None,
    focal_precision: Float[Tensor, "b 2 2"] | None = None, shared_focal: Bool[Tensor, " b"] | None = None,
    lens: LensesInPixels | None = None,
) -> TwoViewCovariance:  # fmt: skip
    """The covariance of pose, focal lengths, lenses and F at the optimum of a robust fit, in closed form.

    Nothing is NaN: what the matches leave open has a deviation of up to `DIFFUSE`. A local covariance knows nothing of
    another optimum: see `significance`. Float64.

    Args:
        x0: points of image 0, px.
        x1: their matches in image 1.
        R: rotation, ``X1 = R X0 + t``.
        t: translation, of any length.
        focal: focal lengths of both images, px.
        principal0: principal point of image 0, px.
        principal1: that of image 1.
        truncation: Sampson distance of a match of usual noise from which on it does not count in the fit, px; infinite
            for plain least squares.
        weight: of each match in the fit, of any scale, P(inlier) where that is known; 1 by default.
        noise: of each match, relative to a usual one's; 1 by default.
        mask: True for a real match; all by default.
        focal_precision: the Hessian, by (log f0, log f1), of the negative logarithm of the prior density that the fit
            had, of which the positive part counts; infinite on the diagonal where a focal length is known exactly. Zero
            by default.
        shared_focal: where the two focal lengths are one parameter; nowhere by default.
        lens: of photographs that are bent; pinholes by default.

    Returns:
        A `TwoViewCovariance`. The result has the same bits in any batch and with any padding.
    """
    kind = torch.float64
    open_prior = torch.zeros(len(R), 2, 2, dtype=kind, device=R.device)
    Pi = open_prior if focal_precision is None else focal_precision.to(kind)
    shared = torch.zeros_like(Pi[:, 0, 0], dtype=torch.bool) if shared_focal is None else shared_focal
    pinholes = LensesInPixels(open_prior[:, 0], open_prior[:, 0] + 1, open_prior[:, 0] + torch.inf, shared)
    lenses = pinholes if lens is None else lens
    known = torch.cat([Pi.diagonal(dim1=-2, dim2=-1), lenses.precision.to(kind)], 1) == torch.inf
    Pi = torch.where(known[:, :2, None] | known[:, None, :2], 0.0, Pi)
    valid, (R, t, f, p0, p1, T, Pi) = _valid(R, t, focal, principal0, principal1, truncation, Pi)
    valid = valid & lenses.value.isfinite().all(1)
    t = t * inverse_root(component_sum(t * t, -1))[:, None]
    real = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    w, n = (torch.ones_like(x0[..., 0]) if a is None else a for a in (weight, noise))
    real = real & valid[:, None] & (x0.isfinite() & x1.isfinite()).all(-1) & (w > 0) & (n > 0) & (w + n).isfinite()
    a0, a1 = (torch.where(real[..., None], x - p[:, None], 0.0).movedim(-1, 0) for x, p in ((x0, p0), (x1, p1)))
    w, n = torch.where(real, w, 0.0).to(kind), torch.where(real, n, 1.0).to(kind)
    F, slopes, basis = tangents(R.movedim(0, -1), t.movedim(0, -1), f.movedim(0, -1))
    area = lenses.half.to(kind).square().T[..., None]
    bend0, bend1 = torch.where(valid, lenses.value.to(kind).T, 0.0)[..., None] / area
    r, J, in_slopes = residual_slopes(F, slopes, a0, a1, bend0, bend1)
    error, J = r / n, torch.cat([J[:PINHOLES], J[PINHOLES:] / area]) / n
    r = error.abs()
    used = _directions(known, shared, lenses.shared)
    s = noise_of(r.detach(), w, T, used.amax(0).sum(0))
    near = (w > 0) & (r < torch.minimum(T, WINDOW * s)[:, None])
    w = torch.where(r < T[:, None], w, 0.0)
    straight0, straight1 = ((h[:2] / h[2]).to(kind) for h in (lifted(a0, bend0), lifted(a1, bend1)))
    moved, still = beside_rotation(straight0, straight1, R.movedim(0, -1), f.movedim(0, -1), n * s[:, None], near)
    w = torch.where(moved < OUTLYING, w, 0.0)
    inflation = torch.empty(len(w), 1, dtype=kind)
    inflation = for_each_pair(noise_inflation, (x0.to(kind), w * error), out=inflation, kind=kind)[:, 0]
    information, from_noise = information_of(r, J, in_slopes, w, T, s, inflation)
    precision = torch.where(known[:, 2:], 0.0, lenses.precision.to(kind))
    C = _without_noise(_covariance(information, Pi.movedim(0, -1), precision.T, used), from_noise, still)
    V = _of_fundamental(C[:PINHOLES, :PINHOLES], F, slopes, p0.movedim(0, -1), p1.movedim(0, -1))
    C = C[:PINHOLES, :PINHOLES] if lens is None else C
    return TwoViewCovariance(C.movedim(-1, 0), basis.movedim(-1, 0), V.movedim(-1, 0), s, valid)


def _valid(*given: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Whether the pairs have cameras, and those, float64, in whose place others stand where they have none.
    given: R, t, focal, principal0, principal1, truncation, focal_precision."""
    R, t, focal, _, _, truncation, _ = given = tuple(a.to(torch.float64) for a in given)
    finite = [a.isfinite().flatten(1).all(1) for a in given if a is not truncation]
    valid = torch.stack([*finite, (t != 0).any(-1), (focal > 0).all(-1), truncation > 0]).all(0)
    zeros, ones = truncation.new_zeros(1), truncation.new_ones(1)
    places = (torch.eye(3, dtype=R.dtype, device=R.device), t.new_tensor([0.0, 0, 1]), ones, zeros, zeros, ones, zeros)
    kept = (valid.reshape(-1, *[1] * (a.dim() - 1)) for a in given)
    return valid, [torch.where(keep, a, place) for keep, a, place in zip(kept, given, places, strict=True)]


def _directions(known: Tensor, shared_focal: Tensor, shared_lens: Tensor) -> Tensor:
    """How the parameters move (9, 9, b), by the columns: a known one never, shared ones together by the first's.
    known: (b, 4), focal lengths and lenses."""
    used = torch.eye(PARAMETERS, dtype=torch.float64, device=known.device)[..., None].repeat(1, 1, len(known))
    for first, shared, (known0, known1) in ((5, shared_focal, known[:, :2].T), (7, shared_lens, known[:, 2:].T)):
        any_known = known0 | known1
        used[first, first] = (~(known0 | (shared & any_known))).to(used.dtype)
        used[first + 1, first + 1] = (~(known1 | shared)).to(used.dtype)
        used[first + 1, first] = (shared & ~any_known).to(used.dtype)
    return used


def _covariance(information: Tensor, Pi: Tensor, lenses: Tensor, used: Tensor) -> Tensor:
    """The inverse (9, 9, b) of information, priors and `DIFFUSE` in the directions that are used; zero in others.
    Pi: (2, 2, b), by the focal lengths. lenses: (2, b), precisions."""
    total = information + torch.diag(information.new_tensor(DIFFUSE) ** -2)[..., None]
    prior = torch.nn.functional.pad(_positive_part(Pi).movedim(-1, 0), (5, 2, 5, 2)).movedim(0, -1)
    prior = prior + torch.diag_embed(torch.nn.functional.pad(lenses.T, (PINHOLES, 0))).movedim(0, -1)
    reduced = product(used.transpose(0, 1), product(total + prior, used))
    idle = 1 - used.amax(0)
    eye = torch.eye(PARAMETERS, dtype=total.dtype, device=total.device)[..., None]
    M = torch.cat([reduced + eye * idle, eye.expand_as(reduced)], 1)
    for k in range(PARAMETERS):  # Gauss and Jordan, of a positive definite matrix without pivots
        M = M - (M[:, k] - eye[:, k])[:, None] * (M[k] / M[k, k])[None]
    inverse = M[:, PARAMETERS:] * (1 - idle) * (1 - idle)[:, None]
    C = product(used, product(inverse, used.transpose(0, 1)))
    return (C + C.transpose(0, 1)) / 2


def _without_noise(C: Tensor, noise: Tensor, still: Tensor) -> Tensor:
    """The covariance (9, 9, b) with that of the direction of translation corrected for what of its information is noise
    (2, 2, b). The other parameters keep their distribution given that direction. What `DIFFUSE` knows of it stays, and
    is all where the camera stood `still` (b,)."""
    S, eye = _inverse(C[3:5, 3:5]), torch.eye(2, dtype=C.dtype, device=C.device)[..., None]
    diffuse = eye * DIFFUSE[3] ** -2
    seen = _positive_part(S - diffuse)
    left = torch.where(still, 0.0, _positive_part(seen - noise))
    grown = _inverse(product(left, product(_inverse(seen + diffuse), left)) + diffuse)
    by_direction = product(C[:, 3:5], S)
    C = C + product(by_direction, product(grown - C[3:5, 3:5], by_direction.transpose(0, 1)))
    return (C + C.transpose(0, 1)) / 2


def _inverse(A: Tensor) -> Tensor:
    """Of symmetric matrices (2, 2, b)."""
    adjugate = torch.stack([torch.stack([A[1, 1], -A[0, 1]]), torch.stack([-A[0, 1], A[0, 0]])])
    return adjugate / (A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1])


def _positive_part(Pi: Tensor) -> Tensor:
    """Symmetric matrices (2, 2, b) with their negative eigenvalues set to zero."""
    a, b, c = Pi[0, 0], (Pi[0, 1] + Pi[1, 0]) / 2, Pi[1, 1]
    mean, half = (a + c) / 2, (a - c) / 2
    radius = sqrt(half * half + b * b)
    high, low = (mean + radius).clamp_min(0), (mean - radius).clamp_min(0)
    turn = torch.where(radius > 0, 1 / torch.where(radius > 0, radius, 1.0), 0.0)
    middle, part = (high + low) / 2, (high - low) / 2 * turn
    return torch.stack([torch.stack([middle + part * half, part * b]), torch.stack([part * b, middle - part * half])])


def _of_fundamental(C: Tensor, F: Tensor, slopes: Tensor, p0: Tensor, p1: Tensor) -> Tensor:
    """The covariance (9, 9, b) of F in pixels at unit norm, of that of the parameters."""
    entries = torch.stack([_uncentred(A, p0, p1) for A in (F, *slopes.unbind(2))]).flatten(1, 2)
    f = entries[0] * inverse_root(component_sum(entries[0] * entries[0]))
    J = entries[1:] * inverse_root(component_sum(entries[0] * entries[0]))
    J = J - component_sum(J * f, 1)[:, None] * f
    V = product(J.transpose(0, 1), product(C, J))
    return (V + V.transpose(0, 1)) / 2


def _uncentred(A: Tensor, p0: Tensor, p1: Tensor) -> Tensor:
    """``T1^T A T0`` (3, 3, b): a matrix between centred pixels as one between pixels."""
    A = torch.stack([A[:, 0], A[:, 1], A[:, 2] - A[:, 0] * p0[0] - A[:, 1] * p0[1]], 1)
    return torch.stack([A[0], A[1], A[2] - A[0] * p1[0] - A[1] * p1[1]])
