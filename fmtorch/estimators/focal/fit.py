"""The maximum a posteriori at the noise of each pair, what the prior costs there, and its gradients."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.focal.cameras import CentredPairs, TwoCameras, translated
from fmtorch.estimators.focal.posterior import Posterior, damped_step
from fmtorch.estimators.focal.prior import focal_cost
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.geometry.arithmetic import component_sum
from fmtorch.geometry.levenberg_marquardt import levenberg_marquardt
from fmtorch.geometry.optimum import STEP_DAMPING, gradient_of_cost
from fmtorch.geometry.robust_losses import KERNELS


class FocalFit(NamedTuple):
    """Models in normalised units, their cameras, and what the logarithm of the likelihood would gain without prior."""

    F: Float[Tensor, "p 3 3"]
    cameras: TwoCameras
    gain: Float[Tensor, " p"]


def fit_focal(
    start: TwoCameras,
    pairs: NormalizedPairs,
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
        centred = CentredPairs(pairs)
        posterior = truncated_posterior(pairs, centred, truncation, sigma, tolerance)
        state = levenberg_marquardt(posterior, (start.axes[..., None], start.focal[..., None]), iterations)
        _, gradient, hessian = focal_cost(state.focal, centred.same_size)
        data = state.hessian.clone()
        data[5:, 5:] -= hessian
        slope = state.gradient.clone()
        slope[5:] -= gradient
        step = damped_step(data, -slope, torch.full_like(state.cost, STEP_DAMPING))
        cameras = TwoCameras(state.axes[..., 0], state.focal[..., 0])
        return FocalFit(_matrices(state.F, centred), cameras, -component_sum(slope * step)[:, 0] / 2)


def attached_focal(
    cameras: TwoCameras,
    pairs: NormalizedPairs,
    counted: Bool[Tensor, "p n"],
    truncation: Float[Tensor, " p"],
    sigma: Float[Tensor, " p"],
) -> Float[Tensor, "p 3 3"]:
    """A zero with the gradients of the optimum, by the implicit function theorem (see `geometry.attached_step`).

    cameras: of the optimum. counted: the matches within the truncation there.
    """
    with torch.no_grad():
        centred = CentredPairs(pairs)
        posterior = truncated_posterior(pairs, centred, truncation, sigma, None)
        state = posterior.evaluate((cameras.axes[..., None], cameras.focal[..., None]), True)
    attached = CentredPairs(pairs)
    weight = torch.where(counted & pairs.mask, pairs.weight, 0)
    unbounded = torch.full_like(truncation, torch.inf)
    gradient = gradient_of_cost(state.F, attached.points, weight, KERNELS["truncated"], unbounded)
    along = component_sum(state.tangents * gradient[:, None]) * posterior.precision
    step = damped_step(state.hessian, along.detach() - along, torch.full_like(state.cost, STEP_DAMPING))
    moved = component_sum(state.tangents.transpose(0, 1) * step[:, None])
    return _matrices(moved, centred)


def truncated_posterior(
    pairs: NormalizedPairs, centred: CentredPairs, truncation: Tensor, sigma: Tensor, tolerance: float | None
) -> Posterior:
    """The posterior of the truncated Sampson error; arguments as of `fit_focal`."""
    scale = truncation[:, None] / pairs.scale
    return Posterior(pairs, centred, "truncated", scale, sigma / pairs.pixels_per_unit, tolerance)


def _matrices(F: Float[Tensor, "9 p 1"], centred: CentredPairs) -> Float[Tensor, "p 3 3"]:
    """Models of points from the principal points as those of normalised points."""
    return translated(F, centred.offset)[..., 0].T.reshape(-1, 3, 3)
