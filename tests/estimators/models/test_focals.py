"""Models with focal lengths: priors, samples, plausible cameras, the search over them."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch import presets
from fmtorch.core import Correspondences, collate
from fmtorch.estimators import BestScore, Candidates, Focal, Pair, Ransac, SaturatedGains, focal_search, refinement
from fmtorch.estimators.focal_search import FocalSearch, PlausibleCandidates
from fmtorch.estimators.models import focal_prior
from fmtorch.estimators.models.focal_prior import QUANTILES, normal_quantiles
from fmtorch.estimators.models.posterior import images_of, no_cameras
from fmtorch.estimators.models.with_focals import FundamentalWithFocals, Refined
from fmtorch.jit.random import Stream
from fmtorch.metrics import nsgd
from tests.estimators.pairs import pair_of, to_units
from tests.laws import scene
from tests.reference import focal as reference
from tests.reference import random
from tests.reference.solvers import skew

WIDE, TALL = (640, 960), (1000, 700)  # (h, w)
Sizes = tuple[tuple[int, int], tuple[int, int]]
SIZES = [(WIDE, WIDE), (WIDE, TALL)]
ROUNDS = 6
FOCAL = {"sampler": "prior", "select": {"scale": 1.0}, "threshold": 1.5}
KNOWN = {
    "nothing": (math.inf, math.inf), "one": (0.0, math.inf), "the other roughly": (math.inf, 0.1),
    "both": (0.001, 0.01), "both roughly": (0.06, 0.06),
}  # fmt: skip
"""Deviations of measured focal lengths."""
EXACT = 1e-5  # deviation that stands for 0
COUNT = 4000
STANDARD_ERROR = 0.5 / math.sqrt(COUNT)  # of a share of the draws, at most


class Photographs(NamedTuple):
    """Matches, the true F of unit norm in pixels, and its parameters as in `reference.focal`."""

    c: Correspondences
    F: np.ndarray
    parameters: np.ndarray


def photographs(
    seed: int, sizes: Sizes = (WIDE, TALL), focal: tuple[float, float] = (1.1, 1.4), count: int = 200,
    noise: float = 0.2, outliers: float = 0.2, relief: float = 1.0, shift: float = 0.0,
) -> Photographs:  # fmt: skip
    """A scene of some relief (0: a plane) from two sides. shift: of the principal points, px."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1.2, 1.2, (count, 2)), rng.uniform(-1, 1, (count, 1)) * relief + 5], 1)
    rotation, t = np.array([0.02, 0.35, 0.05]) + rng.uniform(-0.05, 0.05, 3), np.array([-1.5, 0.1, 0.3])
    K = [reference.calibration(f, size) for f, size in zip(focal, sizes, strict=True)]
    for each in K:
        each[:2, 2] += shift
    R = Rotation.from_rotvec(rotation).as_matrix()
    x0, x1 = ((Y / Y[:, 2:]) @ k.T for Y, k in ((X, K[0]), (X @ R.T + t, K[1])))
    x0, x1 = (x[:, :2] + rng.normal(0, noise, (count, 2)) for x in (x0, x1))
    wrong = rng.random(count) < outliers
    x1[wrong] = rng.uniform([0, 0], sizes[1][::-1], (int(wrong.sum()), 2))
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, count, dtype=torch.bool),
        size0=torch.tensor(sizes[:1]), size1=torch.tensor(sizes[1:]), key=torch.tensor([seed + 1]),
    )  # fmt: skip
    F = np.linalg.inv(K[1]).T @ skew(t) @ R @ np.linalg.inv(K[0])
    return Photographs(c, F / np.linalg.norm(F), np.concatenate([rotation, t / np.linalg.norm(t), np.log(focal)]))


def with_prior(c: Correspondences, seed: int = 0) -> Correspondences:
    prior = np.random.default_rng(seed).uniform(0.1, 1, tuple(c.mask.shape))
    return c.replace(prior=torch.from_numpy(prior))


def error(F: torch.Tensor, pair: Photographs) -> float:
    return float(nsgd(torch.from_numpy(pair.F)[None], F, pair.c.size0, pair.c.size1, key=pair.c.keys))


@pytest.mark.parametrize("sizes", SIZES)
def test_drawn_focal_lengths_are_functions_of_the_draw(sizes: Sizes) -> None:
    pair, seed, start, count = pair_of(photographs(0, sizes).c, 3), 3, 100, 40
    images, depth, normal = images_of(pair), np.empty((2, count)), focal_prior.normal_quantiles()
    focal_prior.draw_depths(images.prior, images.longest, pair.mixed_seed(Stream.FOCAL), pair.key, start, depth)
    ratios = np.log(depth / images.longest[:, None])
    for d in range(count):
        words = [random.number(seed, pair.key, Stream.FOCAL, start + d, k, 3) % focal_prior.QUANTILES for k in range(3)]
        one_camera = pair.same_size and words[2] < focal_prior.SAME_CAMERA_SHARE * focal_prior.QUANTILES
        half = 0.0 if one_camera else normal[words[1]]
        mean = math.log(focal_prior.USUAL_FOCAL) + focal_prior.FOCAL_DEVIATION * normal[words[0]]
        expected = [mean + focal_prior.RATIO_DEVIATION / 2 * half, mean - focal_prior.RATIO_DEVIATION / 2 * half]
        np.testing.assert_allclose(ratios[:, d], expected, atol=1e-12)


def test_hypotheses_pass_through_their_five_matches() -> None:
    pair, start = pair_of(photographs(1, noise=0.0, outliers=0.0).c), 7
    rng = np.random.default_rng(0)
    sample = np.stack([rng.permutation(pair.count)[:5] for _ in range(40)], 1)
    hypotheses = FundamentalWithFocals().solve(pair, sample, start)
    assert hypotheses.F.shape == (len(hypotheses.draw), 9)
    assert len(hypotheses.F) > 40
    assert (np.diff(hypotheses.draw) >= 0).all()
    assert hypotheses.start == start
    own = pair.points[:, hypotheses.sample[:, hypotheses.draw]]
    x0, x1 = (np.concatenate([x, np.ones((1, *x.shape[1:]))]) for x in (own[:2], own[2:]))
    M = hypotheses.F.astype(np.float64).reshape(-1, 3, 3)
    assert np.abs(np.einsum("isk,kij,jsk->ks", x1, M, x0)).max() < 1e-5  # float32 models of points of about 1


def test_a_plane_does_not_deceive_where_cameras_are_plausible() -> None:
    """Seven matches near a plane leave F open; five with a focal length do not."""
    errors = {samples: [] for samples in (0, 250)}  # type: dict[int, list[float]]
    for seed in range(8):
        pair = photographs(seed, (WIDE, WIDE), (0.9, 0.9), 150, 0.5, 0.4, relief=0.02)
        for samples, values in errors.items():
            values.append(error(presets.build("estimator", "fmtorch", focal={"samples": samples})(pair.c, 0).F, pair))
    assert np.median(errors[250]) < 0.02
    assert np.median(errors[250]) < 0.5 * np.median(errors[0])


@pytest.mark.parametrize(("seed", "focal"), [(2, (0.7, 1.6)), (7, (0.8, 1.6))])
def test_doubtful_cameras_are_searched_without_assumptions(seed: int, focal: Any, monkeypatch: Any) -> None:
    pair, estimator = photographs(seed, (WIDE, WIDE), focal, 100, 0.5, 0.5), presets.build("estimator", "fmtorch")
    assert error(estimator(pair.c, 0).F, pair) < 0.005
    monkeypatch.setattr(refinement, "DOUBTFUL_GAIN", math.inf)
    assert error(estimator(pair.c, 0).F, pair) > 0.01


def test_unknown_sizes_are_searched_without_assumptions() -> None:
    pair = photographs(2, (WIDE, WIDE), (1.0, 1.0), 300, noise=0.5)
    bare = pair.c.replace(size0=None, size1=None)
    estimate = presets.build("estimator", "fmtorch")(bare, 0)
    assert bool(estimate.ok[0])
    assert torch.equal(estimate.F, presets.build("estimator", "fmtorch", focal=None)(bare, 0).F)
    assert error(estimate.F, pair) < 0.05


@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("known", KNOWN)
def test_its_cost_and_gradient(same: bool, known: str) -> None:
    rng, out, h, (s0, s1) = np.random.default_rng(0), np.empty(5), 1e-6, KNOWN[known]
    for _ in range(20):
        focal = rng.normal(0.2, 0.4) + rng.normal(0, 0.01 if same else 0.5, 2)
        m0, m1 = (focal + rng.normal(0, np.minimum((s0, s1), 0.3))).tolist()

        def cost(at: np.ndarray, measured: reference.Measured = ((m0, s0), (m1, s1))) -> float:
            return reference.prior_cost(*at, same_size=same, measured=measured)

        computed = focal_prior.focal_cost(focal, focal_prior.focal_prior(same, False, (m0, m1), (s0, s1)), out)
        assert computed == pytest.approx(cost(focal), rel=1e-9, abs=1e-9)
        for i, step in enumerate(h * np.eye(2)):
            # The well, 0.01 wide and 3 deep, has third derivatives of up to 1e8: h^2 of these.
            numeric = (cost(focal + step) - cost(focal - step)) / (2 * h)
            assert out[i] == pytest.approx(numeric, rel=1e-6, abs=1e-3)


def test_a_shared_focal_length_is_one_parameter() -> None:
    prior, out, h = focal_prior.focal_prior(True, True, (0.3, 0.0), (0.05, math.inf)), np.empty(5), 1e-6

    def cost(at: float) -> float:
        return reference.prior_cost(at, at, measured=((0.3, 0.05), (0.0, math.inf)))

    for at in (0.1, 0.3, 0.7):
        assert focal_prior.focal_cost(np.array([at, at]), prior, out) == pytest.approx(cost(at), rel=1e-12)
        assert out[0] == pytest.approx((cost(at + h) - cost(at - h)) / (2 * h), rel=1e-6, abs=1e-8)
        assert (out[1], out[3], out[4]) == (0.0, 1.0, 0.0)
        assert out[2] > 0


def drawn(known: str, same: bool, shared: bool = False) -> np.ndarray:
    """Logarithms (2, COUNT) for measurements of 0.5 and 0.4."""
    depth = np.empty((2, COUNT))
    focal_prior.draw_depths(focal_prior.focal_prior(same, shared, (0.5, 0.4), KNOWN[known]), np.ones(2), 3, 4, 0, depth)
    return np.log(depth)


@pytest.mark.parametrize("known", KNOWN)
def test_draws_follow_prior_and_measurements(known: str) -> None:
    """The product of both, and where a measurement may be wrong three fifths of the prior alone."""
    deviation, a, b = KNOWN[known], 0.4**2, 0.5**2 / 4
    P = np.linalg.inv([[a + b, a - b], [a - b, a + b]])
    measured = np.array([1 / max(s, EXACT) ** 2 for s in deviation])
    total = P + np.diag(measured)
    mean = np.linalg.solve(total, P @ np.full(2, math.log(1.2)) + measured * [0.5, 0.4])
    spread = np.sqrt(np.diag(np.linalg.inv(total)))
    believed = 0.4 if any(0.02 <= s < math.inf for s in deviation) else 1.0
    for log_f, m, s in zip(drawn(known, False), mean, spread, strict=True):
        for z in (-1.0, 0.0, 1.0):
            of_prior = 0.5 * math.erfc((math.log(1.2) - m - z * s) / math.sqrt(2 * (a + b)))
            share = believed * 0.5 * math.erfc(-z / math.sqrt(2)) + (1 - believed) * of_prior
            assert float((log_f < m + z * s).mean()) == pytest.approx(share, abs=4 * STANDARD_ERROR)


def test_draws_of_one_camera() -> None:
    assert np.ptp(drawn("nothing", False, shared=True), axis=0).max() < 1e-12
    assert float((np.ptp(drawn("one", True), axis=0) < 1e-12).mean()) == pytest.approx(0.6, abs=4 * STANDARD_ERROR)
    assert not (np.ptp(drawn("both", True), axis=0) < 1e-12).any()  # which are not measured alike
    share = focal_prior.same_camera_share(0.1, np.array([0.06, 0.06]))
    believed, rest = 0.4 * share, 0.6 * share  # those from the prior have the same share
    equal = float((np.ptp(drawn("both roughly", True), axis=0) < 1e-12).mean())
    assert equal == pytest.approx(believed + rest, abs=4 * STANDARD_ERROR)


def test_how_likely_one_camera_is() -> None:
    """By Bayes' rule, of two normal densities of the difference of what is measured."""
    s = np.array([0.05, 0.1])
    for difference in (0.0, 0.1, 0.5):
        variances = 0.0125 + 0.01**2, 0.0125 + 0.5**2
        same, different = (math.exp(-(difference**2) / 2 / v) / math.sqrt(v) for v in variances)
        expected = 0.6 * same / (0.6 * same + 0.4 * different)
        assert focal_prior.same_camera_share(difference, s) == pytest.approx(expected, rel=1e-12)
    assert focal_prior.same_camera_share(0.0, np.array([0.0, math.inf])) == 0.6


class Found(PlausibleCandidates):
    """A round's candidates, which say what they are told to."""

    def __init__(self, again: bool, one_model: bool) -> None:
        super().__init__(Refined(np.ones((1, 9)), np.zeros(1), np.ones(1)), np.ones(1), no_cameras(1))
        self.again, self.one_model = again, one_model

    def confirmed(self, other: PlausibleCandidates) -> bool:
        return other.again

    def joined(self, other: PlausibleCandidates) -> PlausibleCandidates:
        return other

    @property
    def unique_optimum(self) -> bool:
        return self.one_model


@pytest.mark.parametrize("confirmations", [1, 2, 3])
@pytest.mark.parametrize("min_rounds", [1, 3])
def test_rounds_end_when_enough_of_them_confirm_the_best(min_rounds, confirmations, monkeypatch):
    rng = np.random.default_rng(confirmations)
    again, one_model = rng.random((200, ROUNDS)) < 0.4, rng.random((200, ROUNDS)) < 0.05
    content = rng.random((200, ROUNDS)) < 0.8  # the stopping rule
    pair, draw_counts = pair_of(scene(0)), set()

    def expected(i: int) -> int:
        confirmed = 0
        for turn in range(ROUNDS):
            confirmed += bool(turn and again[i, turn])
            agreed = one_model[i, turn] or confirmed >= confirmations
            if turn + 1 >= min_rounds and agreed and content[i, turn]:
                return turn + 1
        return ROUNDS

    for i in range(200):
        rounds: Iterator[Found] = (Found(bool(a), bool(o)) for a, o in zip(again[i], one_model[i], strict=True))
        monkeypatch.setattr(FocalSearch, "round", lambda self, pair, turn, r=rounds: (next(r), (turn + 1) * 10))
        search = searching(rounds=ROUNDS, min_rounds=min_rounds, confirmations=confirmations)
        object.__setattr__(search, "stop", lambda F, draws, pair, size, i=i: bool(content[i, draws // 10 - 1]))
        _, settled, samples = search(pair)
        assert samples == 10 * expected(i)
        assert settled == content[i, expected(i) - 1]  # the images have one size
        draw_counts.add(samples)
    assert len(draw_counts) > 2


def searching(iterations: int = 12, **options: int) -> FocalSearch:
    focal, refine = Focal(iterations=iterations, samples=0, **options), refinement.Refinement(None)
    return FocalSearch(focal, FundamentalWithFocals(), BestScore(SaturatedGains(0.3)), refine, None, None)


def free(F: np.ndarray, pair: Pair) -> Candidates:
    return Candidates(F, True, pair)


@pytest.mark.parametrize("posterior", [[5.0, 4.9], [5.0, 1.0], [4.9, 5.0]])
@pytest.mark.parametrize("same", [False, True])
def test_the_best_candidates_of_two_rounds_are_one_model_or_not(posterior: list[float], same: bool) -> None:
    F = np.linalg.qr(np.random.default_rng(0).normal(size=(9, 2)))[0].T.copy()  # of cosine 0
    models = np.stack([F[0], F[0] if same else F[1]])
    candidates = PlausibleCandidates(Refined(models, np.zeros(2), np.ones(2)), np.array(posterior), no_cameras(2))
    assert candidates.best == int(np.argmax(posterior))
    assert candidates.unique_optimum == (same or min(posterior) < focal_search.RIVAL_GAIN_SHARE * max(posterior))
    other = PlausibleCandidates(Refined(F[1:], np.zeros(1), np.ones(1)), np.ones(1), no_cameras(1))
    assert candidates.confirmed(other) == bool(np.array_equal(models[candidates.best], F[1]))
    assert candidates.joined(other).F.shape == (3, 9)
    assert candidates.best_alone().posterior.tolist() == [max(posterior)]


def test_rounds_without_candidates_settle_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """All matches may be inliers of the zero model that stands for none."""
    refined = Refined(np.zeros((1, 9)), np.zeros(1), np.ones(1))
    nothing = PlausibleCandidates(refined, np.full(1, -np.inf), no_cameras(1))
    monkeypatch.setattr(FocalSearch, "round", lambda self, pair, turn: (nothing, (turn + 1) * 10))
    search = searching(rounds=3, min_rounds=1)
    object.__setattr__(search, "stop", lambda F, draws, pair, size: True)
    _, settled, samples = search(pair_of(scene(0)))  # of images of one size
    assert (settled, samples) == (False, 30)


def models(turn: float) -> tuple[Pair, np.ndarray, np.ndarray]:
    """A pair of different sizes, its model (9,) and that of a camera turned by an angle."""
    c, _, parameters = photographs(4, outliers=0.1)
    pair, turned = pair_of(c), parameters + np.array([turn, 0, 0, 0, 0, 0, 0, 0])
    right, other = (to_units(reference.fundamental(p, WIDE, TALL), pair) for p in (parameters, turned))
    return pair, right, other


def test_the_prior_is_asked_only_where_good_candidates_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, right, other = models(0.3)
    same, different, search = np.stack([right, right]), np.stack([right, other]), searching()
    monkeypatch.setattr(focal_search, "RIVAL_GAIN_SHARE", 0.0)  # every candidate is a good one
    assert np.array_equal(search.select(free(same, pair), pair, None).F, right)
    _, refined = FundamentalWithFocals().refine(different, pair, 12)
    selection = search.select(free(different, pair), pair, None)
    assert any(np.array_equal(selection.F, refined.models[k]) for k in (0, 1))
    assert selection.cameras is not None
    monkeypatch.setattr(focal_search, "RIVAL_GAIN_SHARE", 2.0)  # none is
    selection = search.select(free(different, pair), pair, None)
    assert np.array_equal(selection.F, right)
    assert selection.cameras is None


def test_a_crop_keeps_the_model_without_prior() -> None:
    c, truth, _ = photographs(3, outliers=0.0, noise=0.1)
    T = np.array([[1, 0, -4000], [0, 1, 0], [0, 0, 1.0]])  # the principal point is far outside
    pair = pair_of(c.replace(x0=c.x0 + torch.tensor([4000.0, 0])))
    F, rival = to_units(truth @ T, pair), to_units(truth @ T + 0.01 * truth.T, pair)
    selection = searching().select(free(np.stack([F, rival]), pair), pair, None)
    assert np.array_equal(selection.F, F)
    assert selection.cameras is None


def test_rounds_go_on_where_the_search_is_not_settled() -> None:
    """An easy pair has one round, random matches have all, and the other search besides; in a batch as alone."""
    estimator = Ransac(**FOCAL, focal={"samples": 40, "rounds": 3, "pool": 4}, hypotheses=20)  # type: ignore[arg-type]
    pairs = [scene(1, 200, outliers=0.0), scene(2, 200, outliers=1.0)]
    assert estimator(collate(pairs), seed=1).samples.tolist() == [40, 3 * 40 + 20]
    assert [int(estimator(pair, seed=1).samples) for pair in pairs] == [40, 3 * 40 + 20]
    patient = Ransac(**FOCAL, focal={"samples": 40, "rounds": 3, "min_rounds": 2})  # type: ignore[arg-type]
    assert int(patient(pairs[0], seed=1).samples) == 2 * 40


def test_images_of_two_sizes_are_searched_without_assumptions_too() -> None:
    easy = photographs(1, (WIDE, WIDE), (1.0, 1.0), 300, 0.5, 0.05).c
    assert int(presets.build("estimator", "fmtorch")(easy, 0).samples) == 3 * 250
    two = photographs(1, (WIDE, TALL), (1.0, 1.0), 300, 0.5, 0.05).c
    assert int(presets.build("estimator", "fmtorch")(two, 0).samples) > 3 * 250


def test_quantiles_are_those_of_the_normal_distribution() -> None:
    normal = normal_quantiles()
    shares = [0.5 * math.erfc(-q / math.sqrt(2)) for q in normal.tolist()]
    np.testing.assert_allclose(shares, (np.arange(QUANTILES) + 0.5) / QUANTILES, atol=2.0**-40)
