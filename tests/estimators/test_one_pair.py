"""The kernel form of the engine's parts against the tensor form, and whole presets in both forms."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest
import torch
from fmtorch.estimators.models import Models as TensorModels
from fmtorch.estimators.one_pair import inliers as compiled_inliers
from fmtorch.estimators.one_pair import solvers as compiled_solvers
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import OnePair, each_pair
from fmtorch.estimators.one_pair.pool import Verifier, likely, shuffled
from fmtorch.estimators.one_pair.selection import Selection
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.pool import Verifier as TensorVerifier
from fmtorch.estimators.pool import by_priority
from fmtorch.estimators.pool import shuffled as shuffled_tensor
from fmtorch.estimators.pool_kernels import drawn_by_prior
from fmtorch.estimators.selection import without_cameras

from fmtorch import metrics, presets
from fmtorch.compiling import switch
from fmtorch.core.streams import Stream
from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.estimators import HypothesizeAndVerify, final_fits, inliers, sampling, scores
from fmtorch.estimators.options import Preselect
from fmtorch.estimators.registry import PARTS, kernel_form
from fmtorch.geometry import eight_point
from tests.conftest import oracle
from tests.estimators.draws import drawn
from tests.laws import degenerate, scene, scenes, small, with_padding

pytest.importorskip("numba", reason="numba is not installed")

PRESETS = (
    "gc_ransac", "gc_ransac_paper", "lmeds", "lmeds_eight_point", "magsac", "msac", "ransac", "ransac_eight_point",
    "usac", "usac_paper",
)  # fmt: skip
COUNTS = (8, 40, 128, 129, 150, 250, 700)
SEED = 3


def both(c: Correspondences) -> tuple[NormalizedPairs, OnePair]:
    (pairs,), _ = normalized_pairs(c, SEED, 7)
    (pair,) = each_pair(pairs)
    return pairs, pair


def told(count: int, kind: str = "all") -> Correspondences:
    c = scene(count, count)
    c = c.replace(noise=torch.linspace(0.2, 5, count)[None])
    return c.replace(**dict.fromkeys(("prior", "quality", "noise"))) if kind == "nothing" else c


def models(pairs: NormalizedPairs, count: int) -> torch.Tensor:
    """Models (count, 9) of random eights of the first pair, which fit some of its matches; the first is zero."""
    index = np.random.default_rng(0).integers(0, int(pairs.count[0]), (count, 8))
    points = pairs.points[:, 0, index].permute(1, 2, 0)
    F, _ = eight_point(points[..., :2], points[..., 2:])
    F[0] = 0
    return F.flatten(1).float()


@pytest.mark.parametrize("kind", ["all", "nothing"])
def test_a_pair_holds_its_own_matches_in_order(kind: str) -> None:
    c = with_padding(collate([told(count, kind) for count in COUNTS]), np.random.default_rng(1), float("nan"))
    buckets, _ = normalized_pairs(c, SEED, 7)
    for pairs in buckets:
        for i, pair in enumerate(each_pair(pairs)):
            mask = pairs.mask[i]
            assert (len(pair), pair.count, pair.slots) == (1, int(pairs.count[i]), len(mask))
            assert (pair.key, pair.seed) == (int(pairs.key[i]), SEED)
            np.testing.assert_array_equal(pair.points, pairs.points[:, i, mask])
            np.testing.assert_array_equal(pair.points32, pairs.points32[:, i, mask])
            np.testing.assert_array_equal(pair.scale, pairs.scale.expand(pairs.mask.shape)[i, mask])
            np.testing.assert_array_equal(pair.weight, pairs.weight[i, mask])
            for name in ("quality", "prior", "noise"):
                value, expected = getattr(pair, name), getattr(pairs, name)
                assert (value is None) == (expected is None) == (kind == "nothing")
                if expected is not None:
                    np.testing.assert_array_equal(value, expected[i, mask])
            assert pair.points.flags.c_contiguous


def test_a_pair_is_a_copy() -> None:
    pairs, pair = both(told(40))
    before = pairs.points.clone()
    pair.points[:] = 0
    assert torch.equal(pairs.points, before)


@pytest.mark.parametrize("kind", ["all", "nothing"])
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", PARTS["sampler"])
def test_samples_and_weights_are_the_same(name: str, count: int, kind: str) -> None:
    pairs, pair = both(told(count, kind))
    part = PARTS["sampler"][name].tensor()
    compiled = kernel_form(part)
    np.testing.assert_array_equal(compiled.weight(pair), part.weight(pairs)[0, :count])
    for size in (7, 8):
        for start, draws in ((0, 100), (70_000, 31)):
            expected = part.draw(pairs, start, draws, size)[:, 0].numpy()
            np.testing.assert_array_equal(drawn(compiled, pair, start, draws, size), expected)


@pytest.mark.parametrize("count", COUNTS)
def test_priors_are_quantised_alike_however_small(count: int) -> None:
    prior = torch.logspace(-12, 0, count)[None]
    pairs, pair = both(told(count).replace(prior=prior))
    part = sampling.PriorWeighted()
    np.testing.assert_array_equal(kernel_form(part).weight(pair), part.weight(pairs)[0, :count])


@pytest.mark.parametrize("count", COUNTS)
def test_matches_are_shuffled_alike(count: int) -> None:
    pairs, pair = both(told(count))
    expected = shuffled_tensor(pairs, Stream.PRESELECTION, pairs.mask)[0, :count].numpy()
    for most in (1, 5, count - 1, count, 2 * count):
        np.testing.assert_array_equal(shuffled(pair, Stream.PRESELECTION, most), expected[:most])


@pytest.mark.parametrize("count", COUNTS)
def test_likely_matches_are_the_same(count: int) -> None:
    pairs, pair = both(told(count))
    order = by_priority(pairs)[0].numpy()
    assert set(order[:count]) == set(range(count))
    for most in (1, 5, count - 1, count, 2 * count):
        few = likely(pair, most)
        chosen = np.sort(order[: min(most, count)])
        np.testing.assert_array_equal(few.points, pair.points[:, chosen])
        np.testing.assert_array_equal(few.support, pair.support[chosen] > 0)
    assert pair.prior is not None
    assert pair.prior.max() < 1  # the pair's own prior stands


def test_matches_of_a_first_look_are_drawn_by_their_prior() -> None:
    """Three times as many of the kind three times as likely, and none that have no prior."""
    n, k, seen = 900, 60, np.zeros(3)
    prior = np.repeat([0.0, 0.2, 0.6], n // 3)
    index = np.empty(k, np.int64)
    for key in range(300):
        drawn_by_prior(prior, 5, key, index)
        assert len(set(index.tolist())) == k
        seen += np.bincount(index // (n // 3), minlength=3)
    assert seen[0] == 0
    assert seen[2] / seen[1] == pytest.approx(3, rel=0.1)
    drawn_by_prior(np.zeros(n), 5, 0, index)
    np.testing.assert_array_equal(index, np.arange(k))


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("score", [scores.InlierCount, scores.TruncatedSquares, scores.SigmaConsensus, scores.Median])
@pytest.mark.parametrize("count", [8, 150, 250, 700])
def test_the_same_models_survive_a_first_look(count: int, score: type, weighted: bool) -> None:
    """Scores are exact sums of rounded gains: a unit of 2^-10 a match apart, a gain for one on the threshold."""
    pairs, pair = both(told(count))
    part = score() if score is scores.Median else score(1.5)
    part.prior_weighted = weighted and score is not scores.Median
    F = models(pairs, 120)
    draw = torch.arange(120)
    tensors = TensorModels(
        F.T[:, None].contiguous(), torch.ones(1, 120, dtype=torch.bool), draw[None], torch.zeros(7, 1, 1).long(), 0
    )
    for preselect in (None, Preselect(survivors=120), Preselect(survivors=40)):
        expected = TensorVerifier(part, preselect)(tensors, pairs)
        arrays = Models(F.numpy(), draw.numpy(), np.zeros((7, 1), np.int64), 0)
        found = Verifier(kernel_form(part), preselect, part.prior_weighted)(arrays, pair)
        assert expected.score is not None
        assert found.score is not None
        assert found.which is not None
        common, mine, theirs = np.intersect1d(found.which, expected.draw[0].numpy(), return_indices=True)
        assert len(found.which) == expected.draw.shape[1]
        assert len(common) >= 0.95 * len(found.which)  # the last to survive may be nearly equal
        a, b = found.score[mine], expected.score[0].numpy()[theirs].astype(np.float64)
        if score is scores.Median:
            np.testing.assert_allclose(np.sqrt(-a), np.sqrt(-b), rtol=1e-3, atol=1e-5)
        else:
            assert np.abs(a - b).max() <= count / 8 * 2.0**-10 + (0 if score is scores.TruncatedSquares else 2)


@pytest.mark.parametrize("count", [8, 9, 150, 701])
@pytest.mark.parametrize("rule", [inliers.WithinThreshold(1.5), inliers.BetterHalf(), inliers.RobustDeviations()])
def test_inliers_are_the_same(rule: inliers.InlierRule, count: int) -> None:
    pairs, pair = both(told(count))
    for F in models(pairs, 20)[1:].double():
        expected = rule(F.reshape(1, 3, 3), pairs)[0, :count].numpy()
        np.testing.assert_array_equal(kernel_form(rule)(F.reshape(3, 3).numpy(), pair), expected)


@pytest.mark.parametrize("sampler", [sampling.Uniform(), sampling.PriorWeighted()])
def test_searches_stop_alike(sampler: sampling.Sampler) -> None:
    decisions = set()
    for outliers in (0.0, 0.3, 0.6):
        pairs, pair = both(scene(2, 300, outliers=outliers))
        rule = inliers.Confidence(0.99, 1.0, sampler)
        compiled = compiled_inliers.Confidence(rule, kernel_form(sampler))
        for F in models(pairs, 20)[1:]:
            for draws in (1, 30, 1000, 100_000):
                expected = rule(F[:, None], torch.tensor([draws]), pairs, 7)
                assert compiled(F.numpy(), draws, pair, 7) == expected
                decisions.add(expected[0])
    assert decisions == {False, True}


@pytest.mark.parametrize("kind", ["all", "nothing"])
@pytest.mark.parametrize("fit", [final_fits.NoFit, final_fits.LeastSquares, final_fits.UnweightedLeastSquares])
def test_fits_are_the_same(fit: type, kind: str) -> None:
    pairs, pair = both(told(300, kind))
    (pool,) = [HypothesizeAndVerify(hypotheses=200).search(pairs)]
    selection = without_cameras(pool.F[:, :, 0].double(), pool)
    inside = inliers.WithinThreshold(1.0)(selection.matrices, pairs)
    for counted in (inside, inside & (inside.cumsum(1) < 6)):  # too few leave the model as it is
        expected = fit().value(selection, pairs, counted)
        one = Selection(selection.matrices[0].numpy(), True, 200)
        found = kernel_form(fit()).value(one, pair, counted[0, :300].numpy())
        np.testing.assert_allclose(found.F, expected.F[0], atol=1e-11)
        np.testing.assert_array_equal(found.at, expected.at[0])
        np.testing.assert_array_equal(found.counted, expected.counted[0, :300])


def in_both_forms(estimator: HypothesizeAndVerify, c: Correspondences) -> tuple[Estimate, Estimate]:
    assert estimator.kernel_form is not None
    compiled = estimator(c, seed=SEED)
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv(switch.SWITCH, "off")
        return compiled, estimator(c, seed=SEED)


@functools.cache
def inputs() -> list[tuple[list[str], Correspondences]]:
    """Batches of pairs, with names: scenes and degenerate pairs; one of which nothing is told; one with noise."""
    many = [(f"scene {i}", scenes()[i]) for i in range(len(scenes()))]
    hopeless = ("empty", "one match", "all points equal", "NaN", "infinite", "some NaN", "huge")
    many += [(kind, degenerate()[kind]) for kind in hopeless]
    for kind in ("8 coincident", "20 coincident", "8 collinear", "20 collinear", "7 random", "20 random"):
        for scale in (2.0**-30, 1.0, 2.0**30):  # exact, so that what is on a line stays there
            c = small()[kind]
            many.append((f"{kind} times {scale}", c.replace(x0=scale * c.x0, x1=scale * c.x1)))
    together = [what for what, _ in many], collate([c for _, c in many])
    return [together, (["nothing told"], told(300, "nothing")), (["noise"], told(300))]


def assert_told_alike(compiled: Estimate, tensors: Estimate, names: list[str]) -> None:
    """Both forms say the same of each pair; how many inliers a model has that fits nothing is a matter of rounding."""
    for i, what in enumerate(names):
        kinds = [re.sub(r"\d+", "N", e.reason[i]) for e in (compiled, tensors)]
        assert kinds[0] == kinds[1], what
        assert bool(compiled.ok[i]) == bool(tensors.ok[i]), what


def assert_scenes_alike(compiled: Estimate, tensors: Estimate, tolerance: float) -> None:
    """The models of the scenes with which `inputs` begins."""
    n = len(scenes())
    torch.testing.assert_close(compiled.F[:n], tensors.F[:n], rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_in_both_forms(name: str) -> None:
    estimator = presets.build("estimator", name)
    for names, c in inputs():
        compiled, tensors = in_both_forms(estimator, c)
        if name in ("gc_ransac_paper", "usac_paper") and "huge" in names:
            # Their best model has its own sample for inliers, or not even that: rounding decides.
            compiled, tensors = (e[[i for i, what in enumerate(names) if what != "huge"]] for e in (compiled, tensors))
            names = [what for what in names if what != "huge"]
        assert_told_alike(compiled, tensors, names)
        differ = (compiled.draws != tensors.draws).nonzero().flatten().tolist()
        assert not [names[i] for i in differ]
        assert compiled.F.dtype == tensors.F.dtype
        assert compiled.inliers.shape == tensors.inliers.shape
        if len(names) > 1:
            assert_scenes_alike(compiled, tensors, 1e-9)
            assert torch.equal(compiled.inliers[: len(scenes())], tensors.inliers[: len(scenes())])


@functools.cache
def real_pairs(step: int = 1) -> tuple[Correspondences, torch.Tensor]:
    """A batch of the real pairs of the test data, of 1000 matches at most, and the true F."""
    file, items = oracle("robust.npz"), []
    numbers = range(0, len(file["names"]), step)
    for i in numbers:
        x0, x1 = (torch.from_numpy(file[f"{i:03d}.{field}"])[None, :1000] for field in ("X1", "X2"))
        size0, size1 = (torch.from_numpy(file[f"{i:03d}.{field}"])[None].long() for field in ("size1", "size2"))
        mask = torch.ones(x0.shape[:2], dtype=torch.bool)
        items.append(Correspondences(x0, x1, mask, size0=size0, size1=size1, key=torch.tensor([i])))
    return collate(items), torch.from_numpy(np.stack([file[f"{i:03d}.F_gt"] for i in numbers]))


def solved(estimate: Estimate, step: int = 1) -> torch.Tensor:
    """Which of the real pairs an estimate solves."""
    c, F_true = real_pairs(step)
    assert c.size0 is not None
    assert c.size1 is not None
    return metrics.nsgd(F_true, estimate.F, c.size0, c.size1) < 0.05


@pytest.mark.parametrize("name", PRESETS)
def test_both_forms_solve_the_same_real_pairs(name: str) -> None:
    """Near-ties may select other models, but neither form is better: at most one pair in 24 is solved by one alone."""
    c = real_pairs()[0].replace(size0=None, size1=None)
    compiled, tensors = in_both_forms(presets.build("estimator", name), c)
    assert int((solved(compiled) != solved(tensors)).sum()) <= 1
    alike = (compiled.F - tensors.F).abs().amax((1, 2)) < 1e-9
    assert int(alike.sum()) >= len(c) / 2


@pytest.mark.parametrize("name", [name for name in PRESETS if name != "usac_paper"])  # whose fit has none
def test_gradients_in_both_forms(name: str) -> None:
    gradients = []
    estimator = presets.build("estimator", name, refit_inliers=False)
    for state in ("on", "off"):
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv(switch.SWITCH, state)
            c = scenes()
            x0 = c.x0.double().requires_grad_()
            estimator(c.replace(x0=x0, x1=c.x1.double())).F.square()[:, 0, 1].sum().backward()
        assert x0.grad is not None
        gradients.append(x0.grad)
    assert bool((gradients[0] != 0).any())
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-6, atol=1e-12)


def test_which_wholes_have_a_kernel_form() -> None:
    """All parts, or none: a user's part, or a stage without a kernel form, takes the tensor form."""

    class Own(scores.TruncatedSquares):
        pass

    assert HypothesizeAndVerify().kernel_form is not None
    for options in (
        {"sampler": "prosac", "score": "magsac", "final": "none"}, {"select": {}, "focal": {}, "final": "adaptive"},
        {"refine": {"kernel": "truncated"}}, {"score": "saturated"}, {"final": "gauss_newton"},
        {"degeneracy": "degensac"}, {"local_optimization": "graph_cut"},
    ):  # fmt: skip
        assert HypothesizeAndVerify(**options).kernel_form is not None, options
    for options in (
        {"score": Own(1.0)}, {"select": {"score": Own(1.0)}},
    ):  # fmt: skip
        assert HypothesizeAndVerify(**options).kernel_form is None, options


def test_kernels_switched_off_are_not_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled_solvers, "samples_of_seven", None)
    monkeypatch.setenv(switch.SWITCH, "off")
    assert bool(HypothesizeAndVerify(hypotheses=100)(scene(0)).ok)
    monkeypatch.setenv(switch.SWITCH, "on")
    with pytest.raises(TypeError):
        HypothesizeAndVerify(hypotheses=100)(scene(0))
