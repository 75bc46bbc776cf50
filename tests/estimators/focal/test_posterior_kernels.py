"""The focal prior by kernels: the whole optimiser against the tensor form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.estimators.focal import cameras, cameras_kernels, posterior_kernels, prior, prior_kernels
from fmtorch.estimators.focal.cameras import CentredPairs, TwoCameras
from fmtorch.estimators.focal.cheirality_kernels import share_in_front
from fmtorch.estimators.focal.fit import fit_focal
from fmtorch.estimators.focal.fit_kernels import gain_without_prior
from fmtorch.estimators.focal.posterior import (
    INLIER_SIGMA_PX,
    LOSS_SCALE_PX,
    PARALLEL_PX,
    Posterior,
    refine_with_prior,
)
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.geometry import eight_point, rank2_manifold
from fmtorch.geometry.optimum import STEP_DAMPING
from fmtorch.geometry.sampson_objective_kernels import LOSSES
from tests.laws import scene

pytest.importorskip("numba", reason="numba is not installed")

CONSTANTS = {
    prior_kernels: (prior, "USUAL_FOCAL FOCAL_DEVIATION RATIO_DEVIATION SAME_CAMERA_DEVIATION SAME_CAMERA_GAIN"),
    cameras_kernels: (cameras, "MIN_FOCAL MAX_FOCAL"),
}
NO_TABLE = np.zeros((2, 2))


def normalized(same_size: bool) -> NormalizedPairs:
    c = scene(3, 200, outliers=0.2).replace(noise=torch.linspace(0.5, 2, 200)[None])
    if not same_size:
        c = c.replace(size1=torch.tensor([[640, 1000]]))
    (made,), _ = normalized_pairs(c, 0, 7)
    return made


def candidates(pair: NormalizedPairs) -> np.ndarray:
    """Models of random twelves, of which some are close."""
    index = np.random.default_rng(0).integers(0, int(pair.count[0]), (6, 12))
    points = pair.points[:, 0, index].permute(1, 2, 0)
    return eight_point(points[..., :2], points[..., 2:])[0].flatten(1).numpy()


class Fit:
    """A `Posterior` minimised by kernels."""

    def __init__(self, pair: NormalizedPairs, loss: str, scale: np.ndarray, sigma: float) -> None:
        n, centred = int(pair.count[0]), CentredPairs(pair)
        self.points = np.ascontiguousarray(centred.points[:, 0, :n].numpy())
        self.weight = pair.weight[0, :n].contiguous().numpy()
        self.s2, self.loss, self.precision = np.ascontiguousarray(scale[:n] ** 2), LOSSES[loss], 1 / sigma**2
        self.longest = centred.longest[:, 0].contiguous().numpy()
        self.offset = centred.offset[:, 0].contiguous().numpy()
        self.same = bool(centred.same_size[0])

    def minimised(self, axes: np.ndarray, lengths: np.ndarray, iterations: int, tolerance: float) -> list[np.ndarray]:
        """Cameras, models, costs, gradients and Hessians at the end; axes and lengths are in place."""
        k = len(axes)
        state = [axes, lengths, np.empty((k, 9)), np.empty(k), np.empty((k, 7)), np.empty((k, 7, 7))]
        data = (self.points, self.weight, self.s2, self.loss, NO_TABLE, self.longest, self.same, self.precision)
        posterior_kernels.minimise(axes, lengths, *data, iterations, tolerance, *state[2:])
        return state


def test_constants_are_those_of_the_tensor_form() -> None:
    for compiled, (tensor_form, names) in CONSTANTS.items():
        for name in names.split():
            assert getattr(compiled, name) == getattr(tensor_form, name), name
    assert cameras_kernels.SQUARINGS == rank2_manifold.SQUARINGS
    damping = (posterior_kernels.FIRST_DAMPING, posterior_kernels.MIN_DAMPING, posterior_kernels.MAX_DAMPING)
    assert Posterior.damping == damping


@pytest.mark.parametrize("same_size", [True, False])
@pytest.mark.parametrize("iterations", [0, 1, 4])
def test_refined_candidates(iterations: int, same_size: bool) -> None:
    pair = normalized(same_size)
    F = candidates(pair)
    k, n = len(F), int(pair.count[0])
    models, cost, front, near = refine_with_prior(torch.from_numpy(F).T[:, None], pair, iterations)
    units = pair.scale.expand(1, pair.mask.shape[1])[0].numpy()
    fit = Fit(pair, "geman_mcclure", LOSS_SCALE_PX / units, INLIER_SIGMA_PX / float(pair.pixels_per_unit))
    axes, lengths = np.empty((k, 2, 3, 3)), np.empty((k, 2))
    cameras_kernels.nearest_cameras(F, fit.offset, fit.longest, axes, lengths)
    state = fit.minimised(axes, lengths, iterations, -1.0)
    np.testing.assert_allclose(axes, near.axes[:, :, :, 0].permute(3, 2, 0, 1).numpy(), atol=1e-7)
    np.testing.assert_allclose(lengths, near.focal[:, 0].T.numpy(), atol=1e-7)
    found, costs, share = np.empty((k, 9)), np.empty(k), np.empty(k)
    posterior_kernels.models_and_costs(state[2], state[3], lengths, fit.offset, fit.same, found, costs)
    np.testing.assert_allclose(found, models[:, 0].T.numpy(), atol=1e-7)
    np.testing.assert_allclose(costs, cost[0].numpy(), atol=1e-5)
    prior_weight = np.ones(n) if pair.prior is None else pair.prior[0, :n].numpy().copy()
    scale = np.ascontiguousarray((units[:n] / LOSS_SCALE_PX) ** 2)
    tolerance = PARALLEL_PX / float(pair.pixels_per_unit)
    share_in_front(axes, lengths, fit.longest, state[2], fit.points, prior_weight, scale, tolerance, share)
    np.testing.assert_allclose(share, front[0].numpy(), atol=1e-5)  # of sums of gains of 2^-20


@pytest.mark.parametrize("same_size", [True, False])
def test_the_final_fit(same_size: bool) -> None:
    """Some step of each is rejected, which ends no fit."""
    pair = normalized(same_size)
    F = candidates(pair)[:1]
    *_, near = refine_with_prior(torch.from_numpy(F).T[:, None], pair, 3)
    start = TwoCameras(near.axes[..., 0], near.focal[..., 0])
    truncation, sigma = torch.tensor([1.5], dtype=torch.float64), torch.tensor([0.75], dtype=torch.float64)
    expected = fit_focal(start, pair, truncation, sigma, 5, 0.05)
    units = pair.scale.expand(1, pair.mask.shape[1])[0].numpy()
    fit = Fit(pair, "truncated", 1.5 / units, 0.75 / float(pair.pixels_per_unit))
    axes = np.ascontiguousarray(start.axes.permute(3, 2, 0, 1).numpy())
    lengths = np.ascontiguousarray(start.focal.T.numpy())
    state = fit.minimised(axes, lengths, 5, 0.05)
    found, gain = np.empty((1, 9)), np.empty(1)
    cameras_kernels.translate(state[2], fit.offset, found)
    np.testing.assert_allclose(found[0], expected.F.flatten().numpy(), rtol=1e-7, atol=1e-9)
    gain_without_prior(state[5], state[4], lengths, fit.same, STEP_DAMPING, gain)
    assert gain[0] == pytest.approx(float(expected.gain), rel=1e-6)


def test_a_candidate_that_is_not_finite_leaves_the_others_alone() -> None:
    pair = normalized(True)
    F = candidates(pair)
    fit = Fit(pair, "geman_mcclure", np.full(256, 0.01), INLIER_SIGMA_PX / float(pair.pixels_per_unit))

    def run(F: np.ndarray) -> list[np.ndarray]:
        axes, lengths = np.empty((len(F), 2, 3, 3)), np.empty((len(F), 2))
        cameras_kernels.nearest_cameras(F, np.zeros(4), fit.longest, axes, lengths)
        return fit.minimised(axes, lengths, 3, -1.0)

    alone = run(F[2:3].copy())
    F[1], F[3] = np.nan, 0
    for one, many in zip(alone[:4], run(F)[:4], strict=True):  # no derivatives are asked for at the end
        np.testing.assert_array_equal(one[0], many[2])
