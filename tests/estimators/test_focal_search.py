"""The search among plausible cameras: when rounds end, which candidates are one model, and which is the estimate."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core import collate
from fmtorch.estimators import Focal, Pair, Ransac, SaturatedGains, focal_search
from fmtorch.estimators.focal_search import FocalSearch, PlausibleCandidates
from fmtorch.estimators.models.posterior import no_cameras
from fmtorch.estimators.models.with_focals import FundamentalWithFocals
from fmtorch.estimators.refinement import Candidates, Refinement
from tests.estimators.models.photographs import TALL, WIDE, photographs
from tests.estimators.pairs import pair_of, to_units
from tests.laws import scene
from tests.reference import focal as reference

ROUNDS = 6
FOCAL = {"sampler": "prior", "select": {"scale": 1.0}, "threshold": 1.5}


class Found(PlausibleCandidates):
    """A round's candidates, which say what they are told to."""

    def __init__(self, again: bool, one_model: bool) -> None:
        super().__init__(np.ones((1, 9)), np.ones(1), no_cameras(1))
        self.again, self.one_model = again, one_model

    def confirmed(self, other: PlausibleCandidates) -> bool:
        assert isinstance(other, Found)
        return other.again

    def joined(self, other: PlausibleCandidates) -> PlausibleCandidates:
        return other

    @property
    def unique_optimum(self) -> bool:
        return self.one_model


@pytest.mark.parametrize("confirmations", [1, 2, 3])
@pytest.mark.parametrize("min_rounds", [1, 3])
def test_rounds_end_when_enough_of_them_confirm_the_best(
    min_rounds: int, confirmations: int, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        result = search(pair)
        assert result.samples == 10 * expected(i)
        assert result.settled == content[i, expected(i) - 1]  # the images have one size
        draw_counts.add(result.samples)
    assert len(draw_counts) > 2


def searching(iterations: int = 12, **options: int) -> FocalSearch:
    """A search that only selects."""
    focal = Focal(iterations=iterations, samples=0, **options)
    return FocalSearch(focal, FundamentalWithFocals(), SaturatedGains(0.3), Refinement(None), None, None)


def free(F: np.ndarray, pair: Pair, valid: np.ndarray | None = None) -> Candidates:
    """Models (k, 9) that the other search has found."""
    return Candidates(F, np.ones(len(F), bool) if valid is None else valid, pair)


@pytest.mark.parametrize("posterior", [[5.0, 4.9], [5.0, 1.0], [4.9, 5.0]])
@pytest.mark.parametrize("same", [False, True])
def test_the_best_candidates_of_two_rounds_are_one_model_or_not(posterior: list[float], same: bool) -> None:
    F = np.linalg.qr(np.random.default_rng(0).normal(size=(9, 2)))[0].T.copy()  # of cosine 0
    models = np.stack([F[0], F[0] if same else F[1]])
    candidates = PlausibleCandidates(models, np.array(posterior), no_cameras(2))
    assert candidates.best == int(np.argmax(posterior))
    assert candidates.unique_optimum == (same or min(posterior) < focal_search.RIVAL_GAIN_SHARE * max(posterior))
    other = PlausibleCandidates(F[1:], np.ones(1), no_cameras(1))
    assert candidates.confirmed(other) == bool(np.array_equal(models[candidates.best], F[1]))
    assert candidates.joined(other).F.shape == (3, 9)
    assert candidates.best_alone().posterior.tolist() == [max(posterior)]


def test_rounds_without_candidates_settle_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """All matches may be inliers of the zero model that stands for none."""
    nothing = PlausibleCandidates(np.zeros((1, 9)), np.full(1, -np.inf), no_cameras(1))
    monkeypatch.setattr(FocalSearch, "round", lambda self, pair, turn: (nothing, (turn + 1) * 10))
    search = searching(rounds=3, min_rounds=1)
    object.__setattr__(search, "stop", lambda F, draws, pair, size: True)
    result = search(pair_of(scene(0)))  # of images of one size
    assert (result.settled, result.samples) == (False, 30)


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
    F = to_units(truth @ T, pair)
    rival = to_units(truth @ T + 0.01 * truth.T, pair)
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
