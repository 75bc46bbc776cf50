"""The engine recovers geometry, stops when it may, differentiates, and says why it fails."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core.types import collate
from fmtorch.estimators import Ransac
from fmtorch.estimators.inliers import residuals_squared_px
from fmtorch.estimators.pair import Pair
from fmtorch.jit.kernel import Kernel
from tests.estimators.pairs import pair_of
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


def test_gradients_reach_the_points() -> None:
    c = scenes()
    x0, x1 = (x.double().requires_grad_() for x in (c.x0, c.x1))
    estimate = Ransac(hypotheses=200, refit_inliers=False)(c.replace(x0=x0, x1=x1))
    estimate.F.square()[:, 0, 1].sum().backward()
    for x in (x0, x1):
        assert x.grad is not None
        assert bool(torch.isfinite(x.grad).all())
        assert bool((x.grad[~estimate.inliers] == 0).all())
        assert bool((x.grad != 0).any())


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


def test_too_few_matches_have_a_reason() -> None:
    estimate = Ransac(solver="eight_point")(scene(0, 7))
    assert estimate.reason == ("7 matches; at least 8 are needed",)
    assert not bool(estimate.ok)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"score": "psac"}, "score is 'psac'; it must be one of: inlier_count"),
        ({"solver": "five_point"}, "solver is 'five_point'"),
        ({"hypotheses": 0}, "hypotheses=0; it must be a whole number of at least 1"),
        ({"confidence": 1.5}, "confidence=1.5; it must be a number between 0 and 1 or null"),
    ],
)
def test_bad_options_are_told(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Ransac(**options)  # type: ignore[arg-type]


def test_find_fundamental_takes_numpy_and_torch_single_and_batched() -> None:
    c = scene(0, 200)
    x0, x1 = c.x0[0].numpy(), c.x1[0].numpy()
    single = fmtorch.find_fundamental(x0, x1, estimator="msac" if "msac" in OWN else "ransac", threshold=0.8)
    batch = fmtorch.find_fundamental(c.x0, c.x1, estimator="msac" if "msac" in OWN else "ransac", threshold=0.8)
    assert torch.equal(single.F, batch.F)
    assert single.F.shape == (1, 3, 3)
    assert bool(single.ok)


def test_find_fundamental_names_what_is_wrong() -> None:
    x = np.zeros((10, 2))
    with pytest.raises(ValueError, match=r"x0 has shape \(10, 3\); it must be"):
        fmtorch.find_fundamental(np.zeros((10, 3)), x)
    with pytest.raises(ValueError, match="they must be equal"):
        fmtorch.find_fundamental(np.zeros((9, 2)), x)
    with pytest.raises(ValueError, match="no preset 'magic' in conf/estimator; there are: "):
        fmtorch.find_fundamental(x, x, estimator="magic")
    with pytest.raises(ValueError, match="estimator=ransac: no option treshold; there are: "):
        fmtorch.find_fundamental(x, x, estimator="ransac", treshold=1.0)


def test_the_pool_is_refined_on_matches_near_one_of_its_models() -> None:
    pair = pair_of(scene(3, 400, outliers=0.5, noise=0.3))
    pool = Ransac(pool=4).search(pair)
    r = np.sqrt(np.min([residuals_squared_px(F, pair) for F in pool.models], 0))

    def near(matches: int) -> Pair:
        refining = Ransac(pool=4, refine={"loss": "truncated", "scale": 1.5, "matches": matches})
        return refining.refine(pool, pair, refining.family).near

    few, every = near(150), near(1000)
    assert every.count == np.count_nonzero(r <= 6.0)  # four times the scale
    inside = {tuple(column) for column in pair.table[:, r <= 6.0].T}
    assert {tuple(column) for column in every.table.T} == inside
    assert few.count == 150
    assert len({tuple(column) for column in few.table.T} & inside) == 150
    assert np.array_equal(few.table, every.table[:, :150])  # in the order that the pair's key decides


WAY = (
    "estimators.search",  # all in a row
    "estimators.sampling",  # drawn
    "estimators.models.fundamental",  # to its solver, and in the end refined
    "geometry.seven_point",  # solved
    "estimators.preselection",  # here without options: hands all models on
    "estimators.scores",  # scored
    "estimators.refinement",  # hands the best on
    "geometry.refine",
)


def test_the_way_of_a_sample_of_seven(monkeypatch: pytest.MonkeyPatch) -> None:
    """The files that a sample passes from draw to refinement, each where it comes first: see `docs/architecture.md`."""
    estimator = Ransac(hypotheses=100, round=100, pool=2, preselect=None, refine={"loss": "truncated"})
    estimator.refine(estimator.search(pair_of(scene(0, 60))), pair_of(scene(0, 60)), estimator.family)  # compiled
    pair, passed = pair_of(scene(0, 60)), dict[str, None]()

    def called(kernel: Kernel[..., Any], *arguments: object) -> object:
        passed[kernel.function.__module__.removeprefix("fmtorch.")] = None
        return kernel.compiled()(*arguments)

    def entered(frame: FrameType, event: str, argument: object) -> None:
        module = frame.f_globals.get("__name__", "")
        if module.startswith("fmtorch.estimators.") and module != "fmtorch.estimators.pair":
            passed[module.removeprefix("fmtorch.")] = None

    monkeypatch.setattr(Kernel, "__call__", called)
    before = sys.gettrace()
    sys.settrace(entered)
    try:
        estimator.refine(estimator.search(pair), pair, estimator.family)
    finally:
        sys.settrace(before)
    assert tuple(passed) == WAY


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
