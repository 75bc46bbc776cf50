"""The engine recovers geometry, stops when it may, differentiates, and says why it fails."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core.types import collate
from fmtorch.estimators import HypothesizeAndVerify, solvers
from fmtorch.estimators.inliers import residuals_squared_px
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from scripts.benchmark.memory import OTHER_LIBRARIES
from tests.laws import quick, scene, scenes

OWN = [n for n in presets.available("estimator") if not n.startswith(OTHER_LIBRARIES)]


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
    outliers = 0.02 if name == "irls_huber" else 0.1 if name.startswith("irls_") else 0.3
    pairs = [scene(i, 300, outliers=outliers, noise=0.2) for i in range(4)]
    estimate = presets.build("estimator", name)(collate(pairs))
    assert bool(estimate.ok.all()), estimate.reason
    for i, F in enumerate(estimate.F):
        assert _true_inlier_error(F, i, 300) < 1.0
        assert abs(float(torch.linalg.matrix_norm(F)) - 1) < 1e-12
        assert abs(float(torch.linalg.det(F))) < 1e-12


def test_confidence_stops_early_and_null_never() -> None:
    easy = scene(0, 200, outliers=0.0, noise=0.1)
    assert int(HypothesizeAndVerify(hypotheses=1000, round=100)(easy).draws) == 100
    assert int(HypothesizeAndVerify(hypotheses=1000, round=100, confidence=None)(easy).draws) == 1000


def test_chunks_of_pairs_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = HypothesizeAndVerify(hypotheses=200)
    whole = estimator(scenes(), seed=3)
    monkeypatch.setattr(solvers, "CPU_SAMPLES", 1)
    chunked = estimator(scenes(), seed=3)
    assert torch.equal(whole.F, chunked.F)
    assert torch.equal(whole.inliers, chunked.inliers)


def test_gradients_reach_the_points() -> None:
    c = scenes()
    x0, x1 = (x.double().requires_grad_() for x in (c.x0, c.x1))
    estimate = HypothesizeAndVerify(hypotheses=200, refit_inliers=False)(c.replace(x0=x0, x1=x1))
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
        value = HypothesizeAndVerify(hypotheses=100)(c).F
    else:
        pruned = presets.build("pruner", stage)(c)
        value = pruned.mask.float() if stage == "gms" else pruned.prior
    factor = torch.ones(1, requires_grad=True)
    (value * factor).square().sum().backward()
    assert factor.grad is not None
    value += 1  # nor are they frozen


def test_too_few_matches_have_a_reason() -> None:
    estimate = HypothesizeAndVerify(solver="eight_point")(scene(0, 7))
    assert estimate.reason == ("7 matches; at least 8 are needed",)
    assert not bool(estimate.ok)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"score": "psac"}, "score is 'psac'; it must be one of: inlier_count"),
        ({"solver": "five_point"}, "solver is 'five_point'"),
        ({"hypotheses": 0}, "hypotheses is 0; it must be at least 1"),
        ({"confidence": 1.5}, "a probability between 0 and 1"),
    ],
)
def test_bad_options_are_told(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HypothesizeAndVerify(**options)  # type: ignore[arg-type]


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
    (pairs,), _ = normalized_pairs(scene(3, 400, outliers=0.5, noise=0.3), 0, 7)
    pool = HypothesizeAndVerify(pool=4).search(pairs)
    r2 = [residuals_squared_px(f.T.reshape(1, 3, 3).double(), pairs) for f in pool.F.unbind(2)]
    r = torch.stack(r2).amin(0).sqrt()

    def near(matches: int) -> NormalizedPairs:
        refining = HypothesizeAndVerify(pool=4, refine={"kernel": "truncated", "scale": 1.5, "matches": matches})
        found = refining.refine(pool, pairs).near
        assert found is not None
        return found

    few, every = near(150), near(1000)
    assert few.count.tolist() == [150] == few.mask.sum(1).tolist()
    assert len(set(few.slot[0].tolist())) == 150
    assert (r[0, few.slot[0]] <= 6.0 + 1e-3).all()  # four times the scale
    places = few.slot.expand(4, -1, -1)
    assert torch.equal(few.points, pairs.points.gather(2, places))
    assert every.count.tolist() == [int((r <= 6.0).sum())]
    assert not every.points[:, ~every.mask].any()
