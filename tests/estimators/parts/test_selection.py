"""The choice among refined candidates."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.estimators import Ransac
from fmtorch.estimators.refinement import Candidates
from fmtorch.estimators.scores import Msac
from fmtorch.estimators.selection import BestOfSearch, BestScore, scores_of
from tests.estimators.pairs import pair_of
from tests.laws import scene


def test_the_first_of_the_pool_or_the_best_score_of_what_is_valid() -> None:
    pair = pair_of(scene(1, 100))
    F = np.random.default_rng(0).normal(size=(6, 9))
    scores = scores_of(Msac(50.0), F, pair)
    best = int(np.argmax(scores))
    assert best > 0
    everything = Candidates(F, np.ones(6, np.bool_), pair)
    np.testing.assert_array_equal(BestOfSearch()(everything, pair).F, F[0])
    np.testing.assert_array_equal(BestScore(Msac(50.0))(everything, pair).F, F[best])
    valid = np.arange(6) != best
    second = int(np.argmax(np.where(valid, scores, -np.inf)))
    np.testing.assert_array_equal(BestScore(Msac(50.0))(Candidates(F, valid, pair), pair).F, F[second])
    assert not BestScore(Msac(50.0))(Candidates(F, np.zeros(6, np.bool_), pair), pair).valid


@pytest.mark.parametrize(("option", "value"), [("select", {"score": "best"}), ("refine", {"loss": "l1"})])
def test_unknown_parts_are_refused(option: str, value: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=next(iter(value.values()))):
        Ransac(**{option: value})(scene(1, 100))  # type: ignore[arg-type]
