"""The engine recovers geometry, stops when it may, differentiates, and says why it fails."""

from typing import Any

import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core import collate
from fmtorch.estimators import Ransac
from fmtorch.jit.kernel import Kernel
from tests.laws import quick, scene, scenes
from tests.variants import OTHER_LIBRARIES, built, variants

OWN = [n for n in variants("estimator") if not n.startswith((*OTHER_LIBRARIES, "homography"))]


def _true_inlier_error(F: torch.Tensor, index: int, count: int) -> float:
    """Median Sampson distance, px, of the noise-free inliers of a scene."""
    clean = scene(index, count, outliers=0.0, noise=0.0)
    h0, h1 = (torch.cat([x[0].double(), torch.ones(count, 1, dtype=torch.float64)], 1) for x in (clean.x0, clean.x1))
    l1, l0 = h0 @ F.T, h1 @ F
    e = (h1 * l1).sum(1).abs() / (l1[:, 0] ** 2 + l1[:, 1] ** 2 + l0[:, 0] ** 2 + l0[:, 1] ** 2).sqrt()
    return float(e.median())


@pytest.mark.parametrize("name", OWN)
def test_recovers_the_geometry(name: str) -> None:
    # M-estimators without samples break down earlier, Huber's, whose loss is unbounded, at once.
    outliers = 0.02 if name == "irls:loss=huber" else 0.1 if name.startswith("irls") else 0.3
    pairs = [scene(i, 300, outliers=outliers, noise=0.2) for i in range(4)]
    estimate = built("estimator", name)(collate(pairs))
    assert bool(estimate.ok.all()), estimate.reason
    for i, F in enumerate(estimate.F):
        assert _true_inlier_error(F, i, 300) < 1.0
        assert abs(float(torch.linalg.matrix_norm(F)) - 1) < 1e-12
        assert abs(float(torch.linalg.det(F))) < 1e-12


def test_confidence_stops_early_and_null_never() -> None:
    easy = scene(0, 200, outliers=0.0, noise=0.1)
    assert int(Ransac(hypotheses=1000, round=100)(easy).samples) == 100
    assert int(Ransac(hypotheses=1000, round=100, confidence=None)(easy).samples) == 1000


@pytest.mark.parametrize("name", OWN)
def test_who_asks_for_gradients_gets_the_same_estimate(name: str) -> None:
    c = scenes()
    attached = c.replace(x0=c.x0.double().requires_grad_(), x1=c.x1.double())
    estimator = quick(name)
    without, with_graph = estimator(c), estimator(attached)
    assert not without.F.requires_grad
    assert torch.equal(without.F, with_graph.F.detach())
    assert torch.equal(without.inliers, with_graph.inliers)


@pytest.mark.parametrize("stage", ["frame_consistency", "position_consistency", "gms", "estimator"])
def test_results_are_free_to_use_in_a_graph(stage: str) -> None:
    c = scenes()
    if stage == "estimator":
        value = Ransac(hypotheses=100)(c).F
    else:
        pruned = presets.build("pruner", stage)(c)
        value = pruned.mask.float() if stage == "gms" else pruned.prior
    factor = torch.ones(1, requires_grad=True)
    (value * factor).square().sum().backward()
    assert factor.grad is not None
    value += 1  # nor are they frozen


def test_the_kernels_that_are_compiled_together_are_those_that_are_called(monkeypatch: pytest.MonkeyPatch) -> None:
    called: set[Kernel[..., Any]] = set()

    def recorded(self: Kernel[..., Any], *arguments: object) -> object:
        called.add(self)
        return self.compiled()(*arguments)

    monkeypatch.setattr(Kernel, "__call__", recorded)
    estimator = presets.build("estimator", "fmtorch")
    for c in (scene(0, 300), scene(0, 300, outliers=0.8).replace(size1=torch.tensor([[700, 900]]))):
        estimator(c)
    assert with_callees(called) == set(estimator.kernels)
    for framed, name in ((False, "position_consistency"), (True, "frame_consistency")):
        c = scene(0, 300)
        frames = {"lafs0": c.lafs0, "lafs1": c.lafs1, "ratio": c.ratio} if framed else {}
        called.clear()
        fmtorch.find_fundamental(c.x0, c.x1, size0=c.size0, size1=c.size1, **frames)
        pruner = presets.build("pruner", name)
        assert with_callees(called) - set(estimator.kernels) == set(pruner.kernels)


def with_callees(kernels: set[Kernel[..., Any]]) -> set[Kernel[..., Any]]:
    """Kernels, and those that they call."""
    reached, new = set[Kernel[..., Any]](), kernels
    while new:
        reached |= new
        new = {callee for each in new for callee in each.calls} - reached
    return reached
