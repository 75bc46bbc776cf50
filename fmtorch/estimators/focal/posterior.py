"""The posterior of two cameras given matches, and its maximum near a model: refinement with the prior."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.focal.cameras import (
    CentredPairs,
    TwoCameras,
    focal_scaling,
    nearest_cameras,
    rotated,
    translated,
)
from fmtorch.estimators.focal.cheirality import share_in_front
from fmtorch.estimators.focal.prior import focal_cost
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.scores import geman_mcclure_gain
from fmtorch.geometry.arithmetic import component_sum, exponential, unit
from fmtorch.geometry.levenberg_marquardt import Damping, TensorObjective, TensorState, levenberg_marquardt
from fmtorch.geometry.residuals import sampson_squared
from fmtorch.geometry.robust_losses import KERNELS
from fmtorch.geometry.sampson_objective import SampsonObjective

INLIER_SIGMA_PX = 0.3  # standard deviation of an inlier's Sampson distance
LOSS_SCALE_PX = 0.7  # Sampson distance at which an inlier's cost is half of what a squared one would be
PARALLEL_PX = 4.0  # in image 1: rays that differ less do not tell on which side of the cameras they meet


@dataclasses.dataclass(frozen=True, eq=False)
class State(TensorState):
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


class Posterior(TensorObjective[State]):
    """The negative logarithm of the posterior, with its derivatives by five rotations and two log focal lengths.

    tolerance: what a step must lower that by, if the fit is to go on.
    """

    damping = Damping(1e-3, 1e-9, 1e6)

    def __init__(
        self,
        pairs: NormalizedPairs,
        centred: CentredPairs,
        kernel: str,
        scale: Tensor,
        sigma: Tensor,
        tolerance: float | None = None,
    ) -> None:
        self.tolerance = tolerance
        self.data = SampsonObjective(centred.points, pairs.weight, KERNELS[kernel], scale)
        self.precision = (1 / sigma).square()[:, None]
        self.longest, self.same_size = centred.longest, centred.same_size
        # The derivatives of E by rotations of U about its three axes and of V about the first two, in products of a
        # column i of U and j of V (3i + j); that by U's third has a second term.
        self.columns = torch.tensor([7, 6, 3, 5, 2], device=self.longest.device)
        self.signs = self.longest.new_tensor([1.0, -1.0, 1.0, 1.0, -1.0])[:, None, None]

    def evaluate(self, parameters: tuple[Tensor, Tensor], derivatives: bool) -> State:
        """As `Objective.evaluate`; parameters: axes and log focal lengths."""
        axes, focal = parameters
        depth = exponential(focal) * self.longest[..., None]
        U, V = axes.unbind(2)
        outer = (U[:, None, :, None] * V[None, :, None]).flatten(2, 3)  # (3, 3, 3i + j, p, k)
        by_depth = focal_scaling(depth)
        F = (outer[:, :, 0] + outer[:, :, 4]) * by_depth
        products, cost = self.data(F.flatten(0, 1), derivatives)
        prior, prior_gradient, prior_hessian = focal_cost(focal, self.same_size)
        cost = cost * self.precision / 2 + prior
        if not derivatives:
            return State(cost, axes, focal, F.flatten(0, 1), cost[:0], cost[:0], cost[:0])
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
        return State(cost, axes, focal, F.flatten(0, 1), gradient, hessian, T)

    def step(self, state: State, damping: Tensor) -> tuple[Tensor, Tensor]:
        """As `Objective.step`."""
        return _moved(state, damped_step(state.hessian, -state.gradient, damping))

    def negligible(self, decrease: Tensor, state: State) -> Bool[Tensor, "p k"]:
        """As `TensorObjective.negligible`."""
        assert self.tolerance is not None
        return decrease <= self.tolerance


def damped_step(
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


def _moved(state: State, step: Tensor) -> tuple[Tensor, Tensor]:
    """The parameters after a step: Cayley rotations of U and V, log focal lengths moved by at most 1."""
    about_third = torch.stack([step[2], torch.zeros_like(step[2])])
    angle = torch.stack([step[[0, 3]], step[[1, 4]], about_third])
    return rotated(state.axes, angle), (state.focal + step[5:].clamp(-1, 1)).clamp(-3, 3)


def refine_with_prior(
    F: Float[Tensor, "9 p k"], pairs: NormalizedPairs, iterations: int = 12
) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"], Float[Tensor, "p k"], TwoCameras]:
    """Models of least ``sum P rho(r) / (2 sigma^2) + cost(f0, f1)``, prior costs, shares of support in front, cameras.

    r is the Sampson distance in pixels, sigma INLIER_SIGMA_PX, rho the loss of Geman & McClure at LOSS_SCALE_PX. The
    sizes of the images must be known. Support is P times the gain of Geman & McClure at that scale (see
    `share_in_front`). A model that is not finite comes back as something that is not, with a prior cost of infinity.
    """
    with torch.no_grad():
        centred, unit_px = CentredPairs(pairs), pairs.pixels_per_unit
        posterior = Posterior(pairs, centred, "geman_mcclure", LOSS_SCALE_PX / pairs.scale, INLIER_SIGMA_PX / unit_px)
        shifted = translated(F, -centred.offset)
        state = levenberg_marquardt(posterior, nearest_cameras(shifted, centred.longest), iterations)
        models = unit(translated(state.F, centred.offset))
        valid = torch.isfinite(models).all(0) & torch.isfinite(state.cost)
        depth = exponential(state.focal) * centred.longest[..., None]
        r2 = sampson_squared(state.F, centred.points) * (pairs.scale / LOSS_SCALE_PX).square()[:, None]
        support = geman_mcclure_gain(r2) * (pairs.mask if pairs.prior is None else pairs.prior)[:, None]
        U, V = state.axes.unbind(2)
        front = share_in_front(U, V, depth, centred.points, support, PARALLEL_PX / unit_px)
        cost = torch.where(valid, focal_cost(state.focal, centred.same_size)[0], torch.inf)
        return models, cost, front, TwoCameras(state.axes, state.focal)
