"""The choice of a model by what is known about cameras: square pixels, a central principal point, a usual focal length.

With the principal points at the image centres a fundamental matrix ``F = K1^-T E K0^-1`` has the same seven degrees of
freedom as an essential matrix and two focal lengths. Refined in these, each candidate pays for implausible focal
lengths: maximum a posteriori instead of maximum likelihood. Cropped photographs violate the assumption, so the result
stands only where it explains the matches about as well as the best model without it.

A pair gets the same bits in any batch (see `sampson_objective`).
"""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.cheirality import share_in_front
from fmtorch.estimators.choice import best_of, ranked
from fmtorch.estimators.problem import Problem
from fmtorch.estimators.scoring import SaturatedGains, geman_mcclure_gain, sampson_squared, score_models
from fmtorch.geometry.rank2 import complement
from fmtorch.geometry.rank2_manifold import start, unit
from fmtorch.geometry.reduce import component_sum
from fmtorch.geometry.robust_kernels import KERNELS
from fmtorch.geometry.sampson_objective import Objective

USUAL_FOCAL = 1.2  # median focal length in units of the longer image side
FOCAL_DEVIATION = 0.4  # of its logarithm, averaged over the two images
RATIO_DEVIATION = 0.3  # of the logarithm of the two focal lengths' ratio
SIGMA = 0.3  # px, standard deviation of an inlier's Sampson distance
SCALE = 0.7  # px, Sampson distance at which an inlier's cost is half of what a squared one would be
# Share of the best gain without prior that gain minus prior cost must reach; chosen on castle-P19, fox, crops of them.
GATE = 0.94
# A pair is open, and the prior is asked, where a candidate of RIVAL of the best gain is further from the best one than
# SAME: 1 - |cosine| of the two as vectors.
RIVAL, SAME = 0.85, 1e-3
PARALLEL = 4.0  # px in image 1: rays that differ less do not tell on which side of the cameras they meet
ITERATIONS = 12  # Levenberg-Marquardt steps
MOST = 12  # candidates that are refined
SHORTEST, LONGEST = 0.25, 5.0  # focal lengths outside are not believed at the start
DAMPING, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-3, 1e-9, 1e6


class FocalPrior:
    """Refines each candidate as a maximum a posteriori over E and two focal lengths and chooses among these.

    Asked only of pairs that are open: where all good candidates are one and the same model, that is the estimate.
    The estimate is the refined candidate with the largest gain (`SaturatedGains`), times the share of its support in
    front of both cameras, minus prior cost, if that reaches GATE of the largest gain without prior; otherwise, and
    where there are no image sizes, the model of the latter.
    scale: of the gain, px. iterations: Levenberg-Marquardt steps. most: candidates refined, those of the largest gain.
    cheirality: whether support behind a camera does not count.
    """

    def __init__(
        self, scale: float, iterations: int = ITERATIONS, most: int = MOST, *, cheirality: bool = True
    ) -> None:
        self.iterations, self.most, self.cheirality = iterations, most, cheirality
        self.gain = SaturatedGains(scale)

    def __call__(
        self, F: Float[Tensor, "9 p k"], problem: Problem, near: Problem, alive: Bool[Tensor, "p k"]
    ) -> Float[Tensor, "9 p"]:
        """As `Choice`."""
        gain = torch.where(alive, score_models(self.gain, F, problem, problem.points), -torch.inf)
        plain = best_of(F, gain, alive)
        if problem.size0 is None or problem.size1 is None:
            return plain
        apart = 1 - component_sum(F * plain[..., None]).abs()
        rival = (gain >= RIVAL * gain.amax(1, keepdim=True)) & ~(apart <= SAME)
        (open_,) = rival.any(1).nonzero(as_tuple=True)
        if not len(open_):
            return plain
        F, gain = ranked(F[:, open_], gain[open_], self.most)
        return plain.index_copy(1, open_, self._chosen(F, gain, problem.only(open_), near.only(open_)))

    def _chosen(
        self, F: Float[Tensor, "9 p k"], gain: Float[Tensor, "p k"], problem: Problem, near: Problem
    ) -> Float[Tensor, "9 p"]:
        """The estimates, of models by descending gain, minus infinity where there is none."""
        focal, prior, front = refine_focal(F, near, self.iterations)
        support = score_models(self.gain, focal, problem, problem.points)
        posterior = ((support * front if self.cheirality else support) - prior).nan_to_num(nan=-torch.inf)
        posterior = torch.where(torch.isfinite(gain), posterior, -torch.inf)
        chosen = ranked(focal, posterior, 1)[0][..., 0]
        return torch.where(posterior.amax(1) >= GATE * gain[:, 0], chosen, F[..., 0])


def refine_focal(
    F: Float[Tensor, "9 p k"], problem: Problem, iterations: int = ITERATIONS
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"], Float[Tensor, "p k"]]:
    """Models of least ``sum P rho(r) / (2 SIGMA^2) + prior(f0, f1)``, prior costs, shares of support in front.

    r is the Sampson distance in pixels, rho the loss of Geman & McClure at SCALE. The sizes of the problem must be
    known. Support is P times the gain of Geman & McClure at SCALE (see `share_in_front`). A model that is not finite
    comes back as something that is not, with a prior cost of infinity.
    """
    assert problem.size0 is not None
    assert problem.size1 is not None
    with torch.no_grad():
        # Coordinates from the principal points, still in normalised units.
        middle = torch.cat([problem.size0.flip(-1), problem.size1.flip(-1)], -1).to(torch.float64)
        offset = ((problem.centre - (middle - 1) / 2) / problem.unit[:, None]).T
        points = problem.points + offset[..., None]
        longest = torch.stack([problem.size0.amax(-1), problem.size1.amax(-1)]).to(torch.float64) / problem.unit
        objective = _Objective(problem, points, longest)
        shifted = _translated(F, -offset)
        state = objective.at(*_start(shifted, longest), True)
        damping = torch.full_like(state.cost, DAMPING)
        for i in range(iterations):
            trial = objective.at(*_moved(state, _step(state, damping)), i + 1 < iterations)
            better = trial.cost < state.cost
            damping = torch.where(better, damping / 10, damping * 10).clamp_(SMALLEST_DAMPING, LARGEST_DAMPING)
            state = state.replaced(trial, better)
        models = unit(_translated(state.F, offset))
        sound = torch.isfinite(models).all(0) & torch.isfinite(state.cost)
        depth = exponential(state.focal) * longest[..., None]
        r2 = sampson_squared(state.F, points) * (problem.units / SCALE).square()[:, None]
        support = geman_mcclure_gain(r2) * (problem.live if problem.prior is None else problem.prior)[:, None]
        front = share_in_front(state.U, state.V, depth, points, support, PARALLEL / problem.unit)
        return models, torch.where(sound, _prior(state.focal)[0], torch.inf), front


@dataclasses.dataclass(frozen=True, eq=False)
class _State:
    """``E = U diag(1, 1, 0) V^T`` and log focal lengths; with F, the cost, its gradient and Gauss-Newton matrix there.

    U, V: (3, 3, p, k), rows first. focal: (2, p, k), logarithms, f in units of the longer side.
    """

    U: Tensor
    V: Tensor
    focal: Tensor
    F: Tensor
    cost: Tensor
    gradient: Tensor
    hessian: Tensor

    def replaced(self, other: _State, condition: Tensor) -> _State:
        """The other state where the condition holds; without derivatives if the other has none."""
        merged = {}
        for field in dataclasses.fields(self):
            mine, new = getattr(self, field.name), getattr(other, field.name)
            merged[field.name] = torch.where(condition, new, mine) if len(new) else mine
        return _State(**merged)


class _Objective:
    """The negative logarithm of the posterior, with its derivatives by five rotations and two log focal lengths."""

    def __init__(self, problem: Problem, points: Tensor, longest: Tensor) -> None:
        self.data = Objective(points, problem.weight(), KERNELS["geman_mcclure"], SCALE / problem.units)
        self.precision = (problem.unit / SIGMA).square()[:, None]
        self.longest = longest
        # Of the derivatives of E by rotations of U about its three axes and of V about the first two.
        self.signs = points.new_tensor([1.0, -1.0, 1.0, 1.0, -1.0])[:, None, None]

    def at(self, U: Tensor, V: Tensor, focal: Tensor, derivatives: bool) -> _State:
        """The state of these parameters."""
        depth = exponential(focal) * self.longest[..., None]
        outer = (U[:, None, :, None] * V[None, :, None]).flatten(
            2, 3
        )  # columns i of U and j of V: (3, 3, 3i + j, p, k)
        scales = _scales(depth)
        F = (outer[:, :, 0] + outer[:, :, 4]) * scales
        products, cost = self.data(F.flatten(0, 1), derivatives)
        prior, prior_gradient, prior_hessian = _prior(focal)
        cost = cost * self.precision / 2 + prior
        if not derivatives:
            return _State(U, V, focal, F.flatten(0, 1), cost, cost[:0], cost[:0])
        tangents = F.new_zeros(3, 3, 7, *focal.shape[1:])
        torch.mul(outer[:, :, [7, 6, 3, 5, 2]], self.signs, out=tangents[:, :, :5])
        tangents[:, :, 2] -= outer[:, :, 1]
        tangents[:, :, :5] *= scales[:, :, None]
        tangents[:, 2, 5], tangents[2, :, 6] = F[:, 2], F[2]
        T = tangents.flatten(0, 1)
        along = component_sum(T[:, :, None] * products[:9, None])  # (7, 10)
        hessian = component_sum(T[:, None] * along.transpose(0, 1)[:9, :, None]) * self.precision
        gradient = along[:, 9] * self.precision
        hessian[5:, 5:] += prior_hessian
        gradient[5:] += prior_gradient
        return _State(U, V, focal, F.flatten(0, 1), cost, gradient, hessian)


def _prior(focal: Float[Tensor, "2 p k"]) -> tuple[Tensor, Tensor, Tensor]:
    """The cost of two log focal lengths, its gradient (2, p, k) and second derivatives (2, 2, 1, 1)."""
    ratio = (focal[0] - focal[1]) / RATIO_DEVIATION
    mean = ((focal[0] + focal[1]) / 2 - math.log(USUAL_FOCAL)) / FOCAL_DEVIATION
    a, b = 1 / RATIO_DEVIATION, 0.5 / FOCAL_DEVIATION
    gradient = torch.stack([a * ratio + b * mean, b * mean - a * ratio])
    hessian = focal.new_tensor([[a * a + b * b, b * b - a * a], [b * b - a * a, a * a + b * b]])
    return (ratio * ratio + mean * mean) / 2, gradient, hessian[..., None, None]


def _step(state: _State, damping: Tensor) -> Float[Tensor, "7 p k"]:
    """The damped Gauss-Newton step, by Gauss-Jordan elimination; the matrix is positive definite, so without pivots."""
    A = state.hessian.clone()
    diagonal = A.diagonal(dim1=0, dim2=1)
    diagonal += diagonal * damping[..., None]
    Q = torch.cat([A, -state.gradient[:, None]], 1)
    for i in range(7):
        column, rest = Q.tensor_split((1,), 1)
        row = rest[i] / column[i]
        Q = torch.addcmul(rest, column, row, value=-1)
        Q[i] = row
    return Q[:, 0]


def _moved(state: _State, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The parameters after a step: Cayley rotations of U and V, log focal lengths moved by at most 1."""
    zero = torch.zeros_like(step[0])
    U = _rotated(state.U, step[:3])
    V = _rotated(state.V, torch.stack([step[3], step[4], zero]))
    return U, V, (state.focal + step[5:].clamp(-1, 1)).clamp(-3, 3)


def _rotated(U: Tensor, angle: Float[Tensor, "3 p k"]) -> Tensor:
    """``U R`` with the rotation by twice the angle whose tangent is half of `angle`, about its direction (Cayley)."""
    x, y, z = c = angle / 2
    n = component_sum(c * c)
    crossed = torch.stack([z * U[:, 1] - y * U[:, 2], x * U[:, 2] - z * U[:, 0], y * U[:, 0] - x * U[:, 1]], 1)
    along = component_sum(U * c, 1)
    # U (I + 2 / (1 + n) ([c]x + [c]x^2)), and [c]x^2 = c c^T - n I.
    rotated: Tensor = U + 2 / (1 + n) * (crossed + along[:, None] * c - n * U)
    return rotated


def _scales(depth: Float[Tensor, "2 p k"]) -> Float[Tensor, "3 3 p k"]:
    """What ``diag(1, 1, depth1) E diag(1, 1, depth0)`` multiplies E by; depth: focal length in the unit of points."""
    scales = depth.new_ones(3, 3, *depth.shape[1:])
    scales[:, 2] = depth[0]
    scales[2] *= depth[1]
    return scales


def _translated(F: Float[Tensor, "9 p k"], offset: Float[Tensor, "4 p"]) -> Float[Tensor, "9 p k"]:
    """F for points from which the offset is taken: ``T(offset1)^T F T(offset0)``."""
    x0, y0, x1, y1 = offset[..., None]
    a, b, c = F.reshape(3, 3, *F.shape[1:]).unbind(1)
    G = torch.stack([a, b, c + x0 * a + y0 * b], 1)
    return torch.stack([G[0], G[1], G[2] + x1 * G[0] + y1 * G[1]]).flatten(0, 1)


def _start(F: Float[Tensor, "9 p k"], longest: Float[Tensor, "2 p"]) -> tuple[Tensor, Tensor, Tensor]:
    """U, V and log focal lengths near F: the focal lengths that F has, the usual ones where these are implausible."""
    G, e0, e1 = start(F)
    square = bougnoux(G, e0, e1) / longest[..., None].square()
    plausible = ((square > SHORTEST**2) & (square < LONGEST**2)).all(0)
    focal = torch.where(plausible, logarithm(torch.where(plausible, square, 1)) / 2, math.log(USUAL_FOCAL))
    depth = 1 / (exponential(focal) * longest[..., None])
    M, e0, e1 = start(G * _scales(depth).flatten(0, 1), 0)
    p, q = complement(e0)
    a, b = complement(e1)
    # In the planes across the epipoles M is 2 x 2; its nearest orthogonal matrix gives both singular values 1.
    Mp, Mq = (component_sum(M.reshape(3, 3, *M.shape[1:]) * v, 1) for v in (p, q))
    m00, m01, m10, m11 = (component_sum(s * t) for s in (a, b) for t in (Mp, Mq))
    sign = torch.where(m00 * m11 >= m01 * m10, 1.0, -1.0).to(M)
    c, s = m00 + sign * m11, m10 - sign * m01
    norm = (c * c + s * s).sqrt()
    c, s = c / norm, s / norm
    U = torch.stack([a * c + b * s, sign * (b * c - a * s), e1], 1)
    return U, torch.stack([p, q, e0], 1), focal


def bougnoux(
    F: Float[Tensor, "9 p k"], e0: Float[Tensor, "3 p k"], e1: Float[Tensor, "3 p k"]
) -> Float[Tensor, "2 p k"]:
    """Squared focal lengths of both cameras from F with epipoles e0, e1, principal points at the origin.

    May be negative or infinite: where the optical axes meet, F does not determine them. Bougnoux (ICCV 1998).
    """

    def squared(f: Tensor, e: Tensor) -> Tensor:
        r = f[0] * -e[1] + f[1] * e[0]  # the last row of [e]x times F
        value: Tensor = -(r[2] * f[2, 2]) / (r[0] * f[2, 0] + r[1] * f[2, 1])
        return value

    f = F.reshape(3, 3, *F.shape[1:])
    return torch.stack([squared(f, e1), squared(f.transpose(0, 1), e0)])


def exponential(x: Tensor) -> Tensor:
    """exp(x) for |x| up to about 5 by arithmetic alone: library functions differ in the last bit with memory layout.

    Pade's approximant of order 4 at x / 32, to rounding there, and five squarings.
    """
    y = x / 32
    y2 = y * y
    even, odd = 1680 + y2 * (180 + y2), y * (840 + 20 * y2)
    value = (even + odd) / (even - odd)
    for _ in range(5):
        value = value * value
    return value


def logarithm(x: Tensor) -> Tensor:
    """ln(x) of positive numbers, to rounding, by arithmetic alone: the series of atanh at the mantissa."""
    mantissa, exponent = torch.frexp(x)
    m = mantissa * math.sqrt(2)
    z = (m - 1) / (m + 1)
    z2 = z * z
    series = torch.full_like(z, 1 / 19)
    for k in range(17, 0, -2):
        series = series * z2 + 1 / k
    value: Tensor = 2 * z * series + (exponent.to(x.dtype) - 0.5) * math.log(2)
    return value
