"""LMedS: the median residual, against its definition."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.estimators.scores import Median
from tests.estimators.pairs import FEW, known, models, named, pair_of
from tests.estimators.residuals import residuals
from tests.reference.ransac import lower_median

RECTIFIED = np.array([[0, 0, 0, 0, 0, 1, 0, -1, 0]], np.float32)  # x1' F x0 = y0 - y1: r^2 = (y1 - y0)^2 / 2


@pytest.mark.parametrize("given", ["scene 40", "scene 151", "scene 700", "real 7", *FEW])
def test_scores_are_those_of_the_definition(given: str) -> None:
    """The median of numbers between bounds is between the medians of these."""
    pair = named(given)
    F, which = models(pair, 8).astype(np.float32), np.array([5, 1, 2, 3, 4, 2])
    unit = float(pair.pixels_per_unit)
    for k, score in zip(which, Median()(F, which, pair), strict=True):
        r = residuals(F[k], pair, unit)
        noise = pair.pixels_per_noise / unit  # which does not count here
        low, high = (lower_median(((x / noise) ** 2).tolist()) for x in (r.low, r.high))
        assert low <= -score <= high


@pytest.mark.parametrize("kind", ["equal", "tiny and huge", "some zero", "NaN"])
@pytest.mark.parametrize("count", [8, 101])
def test_the_median_of_unusual_residuals(kind: str, count: int) -> None:
    pair = pair_of(known(count, "nothing"))
    apart = {
        "equal": np.full(count, 0.5), "tiny and huge": 10.0 ** np.linspace(-15, 15, count),
        "some zero": np.arange(count) // (0.6 * count), "NaN": np.where(np.arange(count) < 3, np.nan, np.arange(count)),
    }[kind]  # fmt: skip
    pair.table[:4] = 0
    pair.table[3] = np.random.default_rng(0).permutation(apart)
    (score,) = Median()(RECTIFIED, np.zeros(1, np.int64), pair)
    ordered = sorted(np.where(np.isnan(apart), np.inf, apart).astype(np.float32).astype(float))
    # A square, a sum of two, a quotient: three roundings of float32.
    assert -score == pytest.approx(lower_median(ordered) ** 2 / 2, rel=3 * 2.0**-24)
