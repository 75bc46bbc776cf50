"""The parts that make `fmtorch`, on the arrays of one pair, against the tensor form; and both presets in both forms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from fmtorch.estimators.inliers import WithinThreshold
from fmtorch.estimators.models import Pool
from fmtorch.estimators.one_pair import ahead
from fmtorch.estimators.one_pair.focal.cameras import CentredPair, TwoCameras
from fmtorch.estimators.one_pair.focal.selection import Candidates
from fmtorch.estimators.one_pair.models import Pool as PoolOfOne
from fmtorch.estimators.one_pair.pair import OnePair
from fmtorch.estimators.one_pair.refinement import Near, near_models
from fmtorch.estimators.one_pair.selection import Selection, scored
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.scores import score_models

from fmtorch import find_fundamental, presets
from fmtorch.compiling.kernel import Kernel
from fmtorch.core.types import collate
from fmtorch.estimators import HypothesizeAndVerify, final_fits, pool, saturated_gains
from fmtorch.estimators.engine import Form
from fmtorch.estimators.registry import kernel_form
from tests.estimators.test_one_pair import both, in_both_forms, models, real_pairs, solved, told
from tests.laws import SMALL_KINDS, degenerate, scene, small

pytest.importorskip("numba", reason="numba is not installed")

PRESETS = ("fmtorch", "fmtorch_max", "fmtorch_fast")
COUNTS = (40, 150, 700)
FEW_ROUNDS = {"rounds": 2, "min_rounds": 1}


def sized(count: int, same: bool = True) -> tuple[NormalizedPairs, OnePair]:
    """A pair whose images have sizes, told all, in both forms."""
    c = told(count)
    return both(c if same else c.replace(size1=torch.tensor([[700, 900]])))


def searched(pairs: NormalizedPairs, count: int) -> torch.Tensor:
    """The best models (count, 9) of a short search, float32, of unit norm."""
    return HypothesizeAndVerify(hypotheses=200, pool=count).search(pairs).F[:, 0].T.contiguous()


def forms(**options: object) -> tuple[Form, Form]:
    """An estimator's tensor form and its kernel form."""
    estimator = HypothesizeAndVerify(**options)  # type: ignore[arg-type]
    assert estimator.kernel_form is not None
    return estimator.tensor_form, estimator.kernel_form


def pools(F: torch.Tensor, size: int) -> tuple[Pool, PoolOfOne]:
    """The same models (k, 9), float32, in pools of a size, which may be larger, of both forms."""
    k = len(F)
    tensors = Pool.empty(1, size, torch.device("cpu"))
    tensors.F[:, 0, :k], tensors.score[0, :k] = F.T, torch.arange(k, 0, -1).float()
    arrays = PoolOfOne(np.zeros((size, 9), np.float32), np.full(size, -np.inf), k)
    arrays.F[:k], arrays.score[:k] = F.numpy(), np.arange(k, 0, -1)
    return tensors, arrays


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_saturated_gains(count: int, weighted: bool) -> None:
    pairs, pair = both(told(count))
    part = saturated_gains.SaturatedGains(1.0, weighted)
    F = models(pairs, 60)
    expected = score_models(part, F.T[:, None].contiguous(), pairs)[0].double().numpy()
    found = scored(kernel_form(part), F.numpy().astype(np.float64), pair)
    # Two roots a match, each of a sum of gains of 2^-10 that may round to a neighbour: a root moves by 2^-5 at most.
    assert np.abs(found - expected).max() <= 2 * np.sqrt(count) * 2.0**-10 + 2.0**-5
    assert np.median(np.abs(found - expected)) <= 2.0**-9


@pytest.mark.parametrize("most", [None, 20, 1000])
@pytest.mark.parametrize("count", COUNTS)
def test_matches_near_a_pool(count: int, most: int | None) -> None:
    pairs, pair = both(told(count))
    F = models(pairs, 6)
    if most is not None:
        assert near_models(F[:0].numpy(), pair, Near.of(pair, 6.0, most)).count == 0
        assert int(pool.near_models(torch.zeros(9, 1, 3), pairs, 6.0, most).count) == 0
    expected = pool.near_models(F.T[:, None].contiguous(), pairs, 6.0, most)
    found = near_models(F.numpy(), pair, Near.of(pair, 6.0, most))
    n = int(expected.count)
    np.testing.assert_array_equal(found.points, expected.points[:, 0, :n])
    np.testing.assert_array_equal(found.weight, expected.weight[0, :n])
    np.testing.assert_array_equal(found.scale, expected.scale[0, :n])
    assert found.count == n


@pytest.mark.parametrize("loss", ["truncated", "geman_mcclure", "magsac"])
@pytest.mark.parametrize("count", COUNTS)
def test_the_refined_pool(count: int, loss: str) -> None:
    """A model of zeros is among them, and places that hold none."""
    pairs, pair = both(told(count))
    tensors, kernels = forms(refine={"kernel": loss, "scale": 1.5, "iterations": 2, "matches": 100}, pool=8)
    given = pools(torch.cat([torch.zeros(1, 9), searched(pairs, 4)]), 8)
    expected = tensors.selected.refine(given[0], pairs)
    found = kernels.selected.refine(given[1], pair)
    np.testing.assert_array_equal(found.valid, [True] * 5)
    np.testing.assert_allclose(found.models, expected.F[:, 0, :5].T.numpy(), atol=1e-6)
    empty = kernels.selected.refine(PoolOfOne.of(pair, 8), pair)
    assert not empty.valid.any()
    assert empty.near.count == 0
    assert not kernels.selected.select(empty, pair).found


@pytest.mark.parametrize("same_size", [True, False])
def test_the_hypotheses_of_the_focal_search(same_size: bool) -> None:
    """The same draws, and nearly always the same models: two roots close together may be found by one form alone."""
    pairs, pair = sized(300, same_size)
    tensors, kernels = forms(select={}, focal={}, sampler="prior")
    expected = tensors.selected.focal.search.generator(pairs, 50, 100)
    found = kernels.selected.focal.search.__self__.generator(pair, 50, 100)
    draws, theirs = found.start + found.draw, expected.draw[expected.valid].numpy()
    assert len(set(draws) ^ set(theirs)) <= 1
    counts = [np.bincount(some - 50, minlength=100) for some in (draws, theirs)]
    agree = counts[0] == counts[1]
    assert agree.mean() > 0.97
    mine = found.F[agree[draws - 50]]
    others = expected.F[:, expected.valid].T.numpy()[agree[theirs - 50]]
    assert np.quantile(np.abs(mine - others).max(1), 0.95) < 1e-5


@pytest.mark.parametrize("same_size", [True, False])
@pytest.mark.parametrize("count", COUNTS)
def test_candidates_and_the_choice_among_them(count: int, same_size: bool) -> None:
    pairs, pair = sized(count, same_size)
    tensors, kernels = forms(select={"scale": 1.0}, focal={"iterations": 3, "candidates": 4})
    given = pools(searched(pairs, 5), 6)
    part, compiled = tensors.selected.focal.selection, kernels.selected.focal.selection
    expected = part.refined(given[0].models, given[0].valid, pairs, pairs)
    found = compiled.refined(given[1].models, given[1].valid, pair, pair)
    np.testing.assert_allclose(found.F, expected.F[:, 0, :5].T.numpy(), atol=1e-6)
    np.testing.assert_allclose(found.cameras.focal, expected.cameras.focal[:, 0, :5].T.numpy(), atol=1e-6)
    np.testing.assert_allclose(found.posterior, expected.posterior[0, :5].numpy(), rtol=0.02, atol=0.1)
    assert pair.same_size == pairs.same_size == [same_size]
    assert found.unambiguous() == expected.unambiguous()
    assert found.same_best(found) == expected.same_best(expected) == [True]
    assert CentredPair.of(pair).same_size == same_size
    for others in (None, (expected, found)):
        theirs = part.select(dataclasses.replace(given[0], near=pairs), pairs, others and others[0])
        mine = compiled.select(dataclasses.replace(given[1], near=pair), pair, others and others[1])
        assert mine.cameras.known == bool(theirs.cameras.known)
        assert abs(float(mine.F @ theirs.F[:, 0].numpy())) == pytest.approx(1, abs=1e-3)
        assert mine.found == bool(theirs.found)


def test_the_best_candidates_of_two_rounds_are_one_model_or_not() -> None:
    pairs, _ = sized(60, same=False)
    F = searched(pairs, 2).double().numpy()
    cameras = TwoCameras(np.zeros((2, 2, 3, 3)), np.zeros((2, 2)))
    for posterior, same, one in (([5.0, 4.9], False, False), ([5.0, 1.0], False, True), ([5.0, 4.9], True, True)):
        both_ = np.stack([F[0], F[0] if same else F[1]])
        assert Candidates(both_, np.array(posterior), cameras).unambiguous() == [one]
        alone = Candidates(both_[1:], np.array([1.0]), cameras)
        assert Candidates(both_, np.array(posterior), cameras).same_best(alone) == [same]
    nothing = Candidates(F, np.full(2, -np.inf), cameras)
    assert nothing.unambiguous() == nothing.same_best(nothing) == [False]
    assert not nothing.selection(250).found


@pytest.mark.parametrize("state", ["on", "off"])
def test_rounds_go_on_where_the_search_is_not_settled(state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An easy pair has one round, random matches have all, and the other search besides; in a batch as alone."""
    if state == "off":
        monkeypatch.setenv(switch.SWITCH, "off")
    estimator = HypothesizeAndVerify(
        sampler="prior",
        select={"scale": 1.0},
        threshold=1.5,
        focal={"samples": 40, "rounds": 3, "pool": 4},
        hypotheses=20,
    )
    pairs = [scene(1, 200, outliers=0.0), scene(2, 200, outliers=1.0)]
    assert estimator(collate(pairs), seed=1).draws.tolist() == [40, 3 * 40 + 20]
    assert [int(estimator(pair, seed=1).draws) for pair in pairs] == [40, 3 * 40 + 20]
    patient = HypothesizeAndVerify(
        sampler="prior", select={"scale": 1.0}, threshold=1.5, focal={"samples": 40, "rounds": 3, "min_rounds": 2}
    )
    assert int(patient(pairs[0], seed=1).draws) == 2 * 40


@pytest.mark.parametrize("cameras", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_the_adaptive_fit(count: int, cameras: bool) -> None:
    pairs, pair = sized(count)
    tensors, _ = forms(select={"scale": 1.0}, focal={})
    given, _ = pools(searched(pairs, 5), 5)
    candidates = tensors.selected.focal.selection.refined(given.models, given.valid, pairs, pairs)
    start = candidates.selection(given.draws)
    if not cameras:
        start = dataclasses.replace(start, cameras=type(start.cameras).none(start.F))
    inside = WithinThreshold(1.5)(start.matrices, pairs)
    expected = final_fits.AdaptiveGaussNewton().value(start, pairs, inside)
    axes, focal = start.cameras.axes.permute(3, 2, 0, 1)[0].numpy(), start.cameras.focal[:, 0].numpy()
    one = Selection(start.F[:, 0].numpy(), True, 1, TwoCameras(axes.copy(), focal.copy()))
    found = kernel_form(final_fits.AdaptiveGaussNewton()).value(one, pair, inside[0, :count].numpy())
    assert expected.cameras is not None
    assert found.cameras.known == bool(expected.cameras.known)
    assert found.truncation == pytest.approx(float(expected.truncation))
    np.testing.assert_allclose(found.F, expected.F[0], atol=1e-6)
    assert np.count_nonzero(found.counted != expected.counted[0, :count].numpy()) <= 1


@pytest.mark.parametrize("name", PRESETS)
def test_presets_on_scenes(name: str) -> None:
    estimator = presets.build("estimator", name, focal=FEW_ROUNDS)
    for sizes in (((640, 960), (640, 960)), ((640, 960), (700, 900)), None):
        c = collate([scene(i, 200, outliers=0.3) for i in range(4)])
        size0, size1 = (None, None) if sizes is None else (torch.tensor(sizes[k]).expand(4, 2) for k in (0, 1))
        compiled, tensors = in_both_forms(estimator, c.replace(size0=size0, size1=size1))
        assert bool(compiled.ok.all())
        assert bool(tensors.ok.all())
        assert torch.equal(compiled.draws, tensors.draws)
        # Both end at the optimum of nearly the same matches, or beside it: after a share of 1e-4 of the cost.
        assert float((compiled.inliers == tensors.inliers).float().mean()) > 0.98
        assert float((compiled.F - tensors.F).abs().max()) < 1e-3


@pytest.mark.parametrize("name", PRESETS[:2])
def test_both_forms_solve_the_same_real_pairs(name: str) -> None:
    """Near-ties may select other models, but neither form is better."""
    c = real_pairs()[0]
    c = presets.build("pruner", "position_consistency")(c.replace(x0=c.x0.float(), x1=c.x1.float()))
    compiled, tensors = in_both_forms(presets.build("estimator", name, focal=FEW_ROUNDS), c)
    assert int((solved(compiled) != solved(tensors)).sum()) <= 2
    # A decision between the searches may go another way.
    assert float((compiled.draws == tensors.draws).float().mean()) > 0.8


@pytest.mark.parametrize(("name", "factor"), [("fmtorch", 1e-9), ("fmtorch", 1.0), *((name, 1e9) for name in PRESETS)])
def test_few_matches_of_any_scale_are_sound(name: str, factor: float) -> None:
    """Random, collinear, planar, coincident: a reason or a finite model, alone as in a batch; sizes scaled alike."""
    estimator = presets.build("estimator", name, hypotheses=200, focal={"samples": 60, **FEW_ROUNDS})
    pairs = [c for kind, c in small().items() if kind.split(" ", 1)[1] in ("random", *SMALL_KINDS)]
    pairs += [degenerate()[kind] for kind in ("one plane", "identity", "all outliers", "all points equal")]
    scaled = [
        c.replace(
            x0=c.x0.double() * factor, x1=c.x1.double() * factor,
            size0=c.size0.double() * factor, size1=c.size1.double() * factor,
        )
        for c in pairs if c.size0 is not None and c.size1 is not None
    ]  # fmt: skip
    together = estimator(collate(scaled))
    for i, c in enumerate(scaled):
        alone = estimator(c)
        n = c.mask.shape[1]
        assert torch.equal(alone.F[0], together.F[i])
        assert torch.equal(alone.inliers[0], together.inliers[i, :n])
        assert alone.reason[0] == together.reason[i]
        assert bool(torch.isfinite(alone.F).all())
        if bool(alone.ok[0]):
            assert abs(float(torch.linalg.matrix_norm(alone.F[0])) - 1) < 1e-12
            assert abs(float(torch.linalg.det(alone.F[0]))) < 1e-12
        else:
            assert alone.reason[0]
            assert not bool(alone.F.any())


def test_the_kernels_that_are_compiled_together_are_those_that_are_called(monkeypatch: pytest.MonkeyPatch) -> None:
    called: set[Kernel] = set()

    def recorded(self: Kernel, *args: object) -> object:
        called.add(self)
        return self.compiled()(*args)

    monkeypatch.setattr(Kernel, "__call__", recorded)
    estimator = presets.build("estimator", "fmtorch")
    for c in (scene(0, 300), scene(0, 300, outliers=0.8).replace(size1=torch.tensor([[700, 900]]))):
        estimator(c)
    assert with_callees(called) == set(ahead.FOCAL)
    for framed, name in ((False, "position_consistency"), (True, "frame_consistency")):
        c = scene(0, 300)
        frames = {"lafs0": c.lafs0, "lafs1": c.lafs1, "quality": c.quality} if framed else {}
        called.clear()
        find_fundamental(c.x0, c.x1, size0=c.size0, size1=c.size1, **frames)
        assert with_callees(called) - set(ahead.FOCAL) == set(ahead.PRIORS[name])


def with_callees(kernels: set[Kernel]) -> set[Kernel]:
    """Kernels, and those that they call."""
    found, new = set[Kernel](), kernels
    while new:
        found |= new
        new = {callee for each in new for callee in each.calls} - found
    return found


def test_gradients_in_both_forms() -> None:
    """To points and prior, of pairs where both forms find the same optimum; noise is told, cameras are assumed."""
    estimator = presets.build("estimator", "fmtorch")
    c = collate([scene(i, 300, outliers=0.3) for i in range(2)])
    found = []
    for state in ("on", "off"):
        x0, prior = c.x0.double().requires_grad_(), (c.prior.double() if c.prior is not None else c.x0).requires_grad_()
        told_ = c.replace(x0=x0, x1=c.x1.double(), prior=prior, noise=torch.linspace(0.5, 2, 300).expand(2, -1))
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv(switch.SWITCH, state)
            estimator(told_).F.square()[:, 0, 1].sum().backward()
        assert x0.grad is not None
        assert prior.grad is not None
        found.append((x0.grad, prior.grad))
    for one, other in zip(*found, strict=True):
        assert float(other.abs().max()) > 0
        assert float((one - other).abs().max()) < 1e-6 * float(other.abs().max())
