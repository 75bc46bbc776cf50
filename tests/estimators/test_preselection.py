"""Which models are scored on all matches, and on which few matches they are compared before."""

import numpy as np
import pytest

from fmtorch.estimators.preselection import (
    best,
)


@pytest.mark.parametrize(("m", "k"), [(1, 1), (5, 5), (300, 96), (300, 1), (1000, 256)])
def test_the_best_of_a_round_and_the_first_of_equals(m: int, k: int) -> None:
    score = np.random.default_rng(m + k).integers(0, 40, m) / 8.0
    score[::7] = -np.inf
    which = np.empty(k, np.int64)
    best(score, which)
    np.testing.assert_array_equal(which, np.sort(np.argsort(-score, kind="stable")[:k]))
