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
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.cheirality import share_in_front
from fmtorch.estimators.choice import Chosen, TwoCameras, ranked
from fmtorch.estimators.problem import Problem
from fmtorch.estimators.scoring import SaturatedGains, geman_mcclure_gain, score_models
from fmtorch.geometry.arithmetic import component_sum, exponential, logarithm, unit
from fmtorch.geometry.levenberg_marquardt import Damping, TensorObjective, TensorState, levenberg_marquardt
from fmtorch.geometry.optimum import STEP_DAMPING, gradient_of_cost
from fmtorch.geometry.rank2 import complement
from fmtorch.geometry.rank2_manifold import start
from fmtorch.geometry.residuals import sampson_squared
from fmtorch.geometry.robust_kernels import KERNELS
from fmtorch.geometry.sampson_objective import SampsonObjective

USUAL_FOCAL = 1.2  # median focal length in units of the longer image side
FOCAL_DEVIATION = 0.4  # of its logarithm, averaged over the two images
RATIO_DEVIATION = 0.5  # of the logarithm of the two focal lengths' ratio, for images of different sizes
SAME_CAMERA = 0.01  # images of equal size mostly come from one camera: scale of a well in the cost of that logarithm
ODDS = 5.0  # its depth
SIGMA = 0.3  # px, standard deviation of an inlier's Sampson distance
SCALE = 0.7  # px, Sampson distance at which an inlier's cost is half of what a squared one would be
# Share of the best gain without prior that gain minus prior cost must reach; chosen on castle-P19, fox, crops of them.
GATE = 0.85
# A pair is open, and the prior is asked, where a candidate of RIVAL of the best gain is further from the best one than
# SAME: 1 - |cosine| of the two as vectors.
RIVAL, SAME = 0.85, 1e-3
ALIKE = 1e-2  # the same for candidates of plausible cameras: if these agree so well, nobody else is asked
PARALLEL = 4.0  # px in image 1: rays that differ less do not tell on which side of the cameras they meet
SMALLEST_IMAGE = 16.0  # longer side of both images below which sizes are taken for those of another unit than pixels
ITERATIONS = 12  # Levenberg-Marquardt steps
MOST = 12  # candidates that are refined
SHORTEST, LONGEST = 0.25, 5.0  # focal lengths outside are not believed at the start


class FocalPrior:
    """Refines each candidate as a maximum a posteriori over E and two focal lengths and chooses among these.

    The estimate is the refined candidate with the largest gain (`SaturatedGains`), times the share of its support in
    front of both cameras, minus prior cost, if that reaches GATE of the largest gain without prior; otherwise, and
    where there are no image sizes, the model of the latter.
    scale: of the gain, px. iterations: Levenberg-Marquardt steps. most: candidates refined, those of the largest gain,
    besides those that were made with focal lengths. cheirality: whether support behind a camera does not count.
    """

    def __init__(
        self, scale: float, iterations: int = ITERATIONS, most: int = MOST, *, cheirality: bool = True
    ) -> None:
        self.iterations, self.most, self.cheirality = iterations, most, cheirality
        self.gain = SaturatedGains(scale)

    def __call__(
        self,
        F: Float[Tensor, "9 p k"],
        alive: Bool[Tensor, "p k"],
        problem: Problem,
        near: Problem,
        refined: Refined | None = None,
    ) -> Chosen:
        """As `Choice`; of pairs with refined candidates already, all are open."""
        gain = torch.where(alive, score_models(self.gain, F, problem, problem.points), -torch.inf)
        F, gain = ranked(F, gain, F.shape[2])
        plain = Chosen(F[..., 0], TwoCameras.none(problem))
        if problem.size0 is None or problem.size1 is None:
            return plain
        if refined is None:
            (open_,) = self._differ(F, gain, SAME).nonzero(as_tuple=True)
        else:
            open_ = torch.arange(F.shape[1], device=F.device)
        if not len(open_):
            return plain
        own = self.refined(
            F[:, open_, : self.most], torch.isfinite(gain[open_, : self.most]), problem.only(open_), near.only(open_)
        )
        best, posterior = (own if refined is None else own.joined(refined)).best()
        (plausible,) = (posterior >= GATE * gain[open_, 0]).nonzero(as_tuple=True)
        return plain.replaced(open_[plausible], Chosen(best.F[:, plausible], best.cameras[plausible]))

    def refined(
        self, F: Float[Tensor, "9 p k"], alive: Bool[Tensor, "p k"], problem: Problem, near: Problem
    ) -> Refined:
        """The candidates refined on the matches `near` them, with their posteriors."""
        models, prior, front, cameras = refine_focal(F, near, self.iterations)
        support = score_models(self.gain, models, problem, problem.points)
        posterior = (support * front if self.cheirality else support) - prior
        return Refined(models, torch.where(alive, posterior.nan_to_num(nan=-torch.inf), -torch.inf), cameras)

    def settled(self, refined: Refined) -> Bool[Tensor, " p"]:
        """Whether all good candidates are one and the same model."""
        F, posterior = ranked(refined.F, refined.posterior, refined.F.shape[2])
        return torch.isfinite(posterior[:, 0]) & ~self._differ(F, posterior, ALIKE)

    def _differ(self, F: Float[Tensor, "9 p k"], gain: Float[Tensor, "p k"], same: float) -> Bool[Tensor, " p"]:
        """Whether a good candidate is another model than the best, which comes first."""
        apart = 1 - component_sum(F * F[..., :1]).abs()
        return ((gain >= RIVAL * gain[:, :1]) & ~(apart <= same)).any(1)


@dataclasses.dataclass(frozen=True, eq=False)
class Refined:
    """Candidates of greatest posterior nearby, what that is, and their cameras."""

    F: Float[Tensor, "9 p k"]
    posterior: Float[Tensor, "p k"]
    cameras: TwoCameras

    def __getitem__(self, index: Tensor) -> Refined:
        """Those of the selected pairs."""
        return Refined(self.F[:, index], self.posterior[index], self.cameras[index])

    def joined(self, other: Refined) -> Refined:
        """The candidates of both."""
        return Refined(
            torch.cat([self.F, other.F], -1),
            torch.cat([self.posterior, other.posterior], -1),
            self.cameras.joined(other.cameras),
        )

    def best(self) -> tuple[Chosen, Float[Tensor, " p"]]:
        """The candidate of the greatest posterior, the first of several, and that."""
        top, order = torch.sort(self.posterior, dim=1, descending=True, stable=True)
        first = order[:, :1]

        def taken(x: Tensor) -> Tensor:
            return x.gather(-1, first.expand(*x.shape[:-2], -1, -1))[..., 0]

        return Chosen(taken(self.F), TwoCameras(taken(self.cameras.axes), taken(self.cameras.focal))), top[:, 0]


class Cameras:
    """What is known of the cameras of some pairs.

    offset: (4, P) from the centre of the points to the principal points. points: (4, P, N) from the principal points.
    longest: (2, P) the longer sides of the images. All in normalised units. same_size: (P,).
    """

    def __init__(self, problem: Problem) -> None:
        assert problem.size0 is not None
        assert problem.size1 is not None
        middle = torch.cat([problem.size0.flip(-1), problem.size1.flip(-1)], -1).to(torch.float64)
        # Half a pixel, of images in pixels; of sizes in another unit nobody knows what it is, and it is small.
        pixel = torch.where(middle.amax(-1, keepdim=True) < SMALLEST_IMAGE, 0.0, 1.0)
        self.offset = ((problem.centre - (middle - pixel) / 2) / problem.unit[:, None]).T
        self.points = problem.points + self.offset[..., None]
        self.longest = torch.stack([problem.size0.amax(-1), problem.size1.amax(-1)]).to(torch.float64) / problem.unit
        self.same_size = (problem.size0 == problem.size1).all(-1)


def refine_focal(
    F: Float[Tensor, "9 p k"], problem: Problem, iterations: int = ITERATIONS
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"], Float[Tensor, "p k"], TwoCameras]:
    """Models of least ``sum P rho(r) / (2 SIGMA^2) + prior(f0, f1)``, prior costs, shares of support in front, cameras.

    r is the Sampson distance in pixels, rho the loss of Geman & McClure at SCALE. The sizes of the problem must be
    known. Support is P times the gain of Geman & McClure at SCALE (see `share_in_front`). A model that is not finite
    comes back as something that is not, with a prior cost of infinity.
    """
    with torch.no_grad():
        cameras = Cameras(problem)
        objective = _Objective(problem, cameras, "geman_mcclure", SCALE / problem.units, SIGMA / problem.unit)
        shifted = translated(F, -cameras.offset)
        state = levenberg_marquardt(objective, _start(shifted, cameras.longest), iterations)
        models = unit(translated(state.F, cameras.offset))
        sound = torch.isfinite(models).all(0) & torch.isfinite(state.cost)
        depth = exponential(state.focal) * cameras.longest[..., None]
        r2 = sampson_squared(state.F, cameras.points) * (problem.units / SCALE).square()[:, None]
        support = geman_mcclure_gain(r2) * (problem.live if problem.prior is None else problem.prior)[:, None]
        front = share_in_front(
            state.axes[:, :, 0], state.axes[:, :, 1], depth, cameras.points, support, PARALLEL / problem.unit
        )
        prior = torch.where(sound, _prior(state.focal, cameras.same_size)[0], torch.inf)
        return models, prior, front, TwoCameras(state.axes, state.focal)


class FocalFit(NamedTuple):
    """The maximum a posteriori at the noise of each pair, and how much an optimum without prior would gain.

    F: (P, 3, 3) in normalised units. gain: what the logarithm of the likelihood would rise by.
    """

    F: Float[Tensor, "p 3 3"]
    gain: Float[Tensor, " p"]
    state: _State
    objective: _Objective

    def attached_step(self, problem: Problem, close: Bool[Tensor, "p n"]) -> Float[Tensor, "p 3 3"]:
        """A zero with the gradients of the optimum, by the implicit function theorem (see `geometry.attached_step`).

        close: matches that the fit counts.
        """
        state, precision = self.state, self.objective.precision
        cameras = Cameras(problem)
        weight = torch.where(close & problem.live, problem.weight(), 0)
        unbounded = torch.full_like(precision[:, 0], torch.inf)
        gradient = gradient_of_cost(state.F, cameras.points, weight, KERNELS["truncated"], unbounded)
        along = component_sum(state.tangents * gradient[:, None]) * precision
        damping = torch.full_like(state.cost, STEP_DAMPING)
        step = _solved(state.hessian, along.detach() - along, damping)
        moved = translated(component_sum(state.tangents.transpose(0, 1) * step[:, None]), cameras.offset)
        return moved[..., 0].T.reshape(-1, 3, 3)


def fit_focal(
    start: TwoCameras,
    problem: Problem,
    truncation: Float[Tensor, " p"],
    sigma: Float[Tensor, " p"],
    iterations: int,
    tolerance: float,
) -> FocalFit:
    """The maximum a posteriori of the truncated Sampson error.

    truncation, sigma: of the Sampson distance, px. tolerance: a fit is done once a step lowers its cost, a logarithm of
    the posterior, by no more than this.
    """
    with torch.no_grad():
        cameras = Cameras(problem)
        objective = _Objective(
            problem, cameras, "truncated", truncation[:, None] / problem.units, sigma / problem.unit, tolerance
        )
        state = levenberg_marquardt(objective, (start.axes[..., None], start.focal[..., None]), iterations)
        fitted = translated(state.F, cameras.offset)[..., 0].T.reshape(-1, 3, 3)
        _, gradient, hessian = _prior(state.focal, cameras.same_size)
        data = state.hessian.clone()
        data[5:, 5:] -= hessian
        slope = state.gradient.clone()
        slope[5:] -= gradient
        step = _solved(data, -slope, torch.full_like(state.cost, STEP_DAMPING))
        return FocalFit(fitted, -component_sum(slope * step)[:, 0] / 2, state, objective)


@dataclasses.dataclass(frozen=True, eq=False)
class _State(TensorState):
    """``E = U diag(1, 1, 0) V^T`` and log focal lengths; with F, the cost, its derivatives there.

    axes: U and V, (3, 3, 2, p, k), rows first. focal: (2, p, k), logarithms, f in units of the longer side.
    tangents: (9, 7, p, k), the derivatives of F by five rotations and the two logarithms.
    """

    axes: Tensor
    focal: Tensor
    F: Tensor
    gradient: Tensor
    hessian: Tensor
    tangents: Tensor


class _Objective(TensorObjective[_State]):
    """The negative logarithm of the posterior, with its derivatives by five rotations and two log focal lengths.

    tolerance: what a step must lower that by, if the fit is to go on.
    """

    damping = Damping(1e-3, 1e-9, 1e6)

    def __init__(
        self,
        problem: Problem,
        cameras: Cameras,
        kernel: str,
        scale: Tensor,
        sigma: Tensor,
        tolerance: float | None = None,
    ) -> None:
        self.tolerance = tolerance
        self.data = SampsonObjective(cameras.points, problem.weight(), KERNELS[kernel], scale)
        self.precision = (1 / sigma).square()[:, None]
        self.longest, self.same_size = cameras.longest, cameras.same_size
        # The derivatives of E by rotations of U about its three axes and of V about the first two, in products of a
        # column i of U and j of V (3i + j); that by U's third has a second term.
        self.columns = torch.tensor([7, 6, 3, 5, 2], device=self.longest.device)
        self.signs = self.longest.new_tensor([1.0, -1.0, 1.0, 1.0, -1.0])[:, None, None]

    def evaluate(self, parameters: tuple[Tensor, Tensor], derivatives: bool) -> _State:
        """As `Objective.evaluate`; parameters: axes and log focal lengths."""
        axes, focal = parameters
        depth = exponential(focal) * self.longest[..., None]
        U, V = axes.unbind(2)
        outer = (U[:, None, :, None] * V[None, :, None]).flatten(2, 3)  # (3, 3, 3i + j, p, k)
        by_depth = scales(depth)
        F = (outer[:, :, 0] + outer[:, :, 4]) * by_depth
        products, cost = self.data(F.flatten(0, 1), derivatives)
        prior, prior_gradient, prior_hessian = _prior(focal, self.same_size)
        cost = cost * self.precision / 2 + prior
        if not derivatives:
            return _State(cost, axes, focal, F.flatten(0, 1), cost[:0], cost[:0], cost[:0])
        tangents = F.new_zeros(3, 3, 7, *focal.shape[1:])
        rotations = outer.index_select(2, self.columns).mul_(self.signs)
        rotations[:, :, 2] -= outer[:, :, 1]
        torch.mul(rotations, by_depth[:, :, None], out=tangents[:, :, :5])
        tangents[:, 2, 5], tangents[2, :, 6] = F[:, 2], F[2]
        T = tangents.flatten(0, 1)
        along = component_sum(T[:, :, None] * products[:9, None])  # (7, 10)
        hessian = component_sum(T[:, None] * along.transpose(0, 1)[:9, :, None]) * self.precision
        gradient = along[:, 9] * self.precision
        hessian[5:, 5:] += prior_hessian
        gradient[5:] += prior_gradient
        return _State(cost, axes, focal, F.flatten(0, 1), gradient, hessian, T)

    def step(self, state: _State, damping: Tensor) -> tuple[Tensor, Tensor]:
        """As `Objective.step`."""
        return _moved(state, _solved(state.hessian, -state.gradient, damping))

    def negligible(self, decrease: Tensor, state: _State, better: Tensor) -> Bool[Tensor, "p k"]:
        """As `TensorObjective.negligible`."""
        assert self.tolerance is not None
        return decrease <= self.tolerance


def _prior(focal: Float[Tensor, "2 p k"], same_size: Bool[Tensor, " p"]) -> tuple[Tensor, Tensor, Tensor]:
    """The cost of two log focal lengths, its gradient (2, p, k) and a Gauss-Newton matrix (2, 2, p, k)."""
    difference = focal[0] - focal[1]
    squared = difference * difference
    mean = (focal[0] + focal[1]) * (0.5 / FOCAL_DEVIATION) - math.log(USUAL_FOCAL) / FOCAL_DEVIATION
    well = torch.where(same_size, SAME_CAMERA**2, 0.0)[:, None] / (squared + SAME_CAMERA**2)
    precision = 1 / RATIO_DEVIATION**2 + 2 * ODDS / SAME_CAMERA**2 * well * well
    cost = mean * mean / 2 + squared / (2 * RATIO_DEVIATION**2) - ODDS * well
    b = 0.5 / FOCAL_DEVIATION
    pull = precision * difference
    gradient = torch.stack([b * mean + pull, b * mean - pull])
    own, other = b * b + precision, b * b - precision
    return cost, gradient, torch.stack([torch.stack([own, other]), torch.stack([other, own])])


def _solved(
    hessian: Float[Tensor, "7 7 p k"], right: Float[Tensor, "7 p k"], damping: Tensor
) -> Float[Tensor, "7 p k"]:
    """The damped Gauss-Newton step, by Gauss-Jordan elimination; the matrix is positive definite, so without pivots."""
    A = hessian.clone()
    diagonal = A.diagonal(dim1=0, dim2=1)
    diagonal += diagonal * damping[..., None]
    Q = torch.cat([A, right[:, None]], 1)
    for i in range(7):
        column, rest = Q.tensor_split((1,), 1)
        row = rest[i] / column[i]
        Q = torch.addcmul(rest, column, row, value=-1)
        Q[i] = row
    return Q[:, 0]


def _moved(state: _State, step: Tensor) -> tuple[Tensor, Tensor]:
    """The parameters after a step: Cayley rotations of U and V, log focal lengths moved by at most 1."""
    about_third = torch.stack([step[2], torch.zeros_like(step[2])])
    angle = torch.stack([step[[0, 3]], step[[1, 4]], about_third])
    return _rotated(state.axes, angle), (state.focal + step[5:].clamp(-1, 1)).clamp(-3, 3)


def _rotated(axes: Float[Tensor, "3 3 *s"], angle: Float[Tensor, 3 * s]) -> Float[Tensor, "3 3 *s"]:
    """``U R`` with the rotation by twice the angle whose tangent is half of `angle`, about its direction (Cayley)."""
    x, y, z = c = angle / 2
    n = component_sum(c * c)
    crossed = torch.stack(
        [z * axes[:, 1] - y * axes[:, 2], x * axes[:, 2] - z * axes[:, 0], y * axes[:, 0] - x * axes[:, 1]], 1
    )
    along = component_sum(axes * c, 1)
    # U (I + 2 / (1 + n) ([c]x + [c]x^2)), and [c]x^2 = c c^T - n I.
    rotated: Tensor = axes + 2 / (1 + n) * (crossed + along[:, None] * c - n * axes)
    return rotated


def scales(depth: Float[Tensor, " 2 *s"]) -> Float[Tensor, " 3 3 *s"]:
    """What ``diag(1, 1, depth1) E diag(1, 1, depth0)`` multiplies E by; depth: focal length in the unit of points."""
    scales = depth.new_ones(3, 3, *depth.shape[1:])
    scales[:, 2] = depth[0]
    scales[2] *= depth[1]
    return scales


def translated(F: Float[Tensor, "9 p k"], offset: Float[Tensor, "4 p"]) -> Float[Tensor, "9 p k"]:
    """F for points from which the offset is taken: ``T(offset1)^T F T(offset0)``."""
    x0, y0, x1, y1 = offset[..., None]
    a, b, c = F.reshape(3, 3, *F.shape[1:]).unbind(1)
    G = torch.stack([a, b, c + x0 * a + y0 * b], 1)
    return torch.stack([G[0], G[1], G[2] + x1 * G[0] + y1 * G[1]]).flatten(0, 1)


def _start(F: Float[Tensor, "9 p k"], longest: Float[Tensor, "2 p"]) -> tuple[Tensor, Tensor]:
    """U and V, and log focal lengths, near F: those that F has, the usual ones where these are implausible."""
    G, e0, e1 = start(F)
    square = bougnoux(G, e0, e1) / longest[..., None].square()
    plausible = ((square > SHORTEST**2) & (square < LONGEST**2)).all(0)
    focal = torch.where(plausible, logarithm(torch.where(plausible, square, 1)) / 2, math.log(USUAL_FOCAL))
    depth = 1 / (exponential(focal) * longest[..., None])
    M, e0, e1 = start(G * scales(depth).flatten(0, 1), 0)
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
    return torch.stack([U, torch.stack([p, q, e0], 1)], 2), focal


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
