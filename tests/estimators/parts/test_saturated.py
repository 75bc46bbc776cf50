"""Gains that saturate where matches crowd, against their definition."""

from __future__ import annotations

import numpy as np
import pytest

from fmtorch.estimators.pair import Pair
from fmtorch.estimators.scores import GRID, SaturatedGains, fractional_bits, saturated_cells
from tests.estimators.pairs import FEW, SCALES, known, models, named, pair_of
from tests.estimators.residuals import residuals
from tests.reference import ransac as reference

GAIN_ROUNDING = 2.0**-21  # of a gain of about one: eight operations in float32


def cells_of(pair: Pair, weighted: bool) -> np.ndarray:
    cells = np.empty((2, pair.count), np.int32)
    saturated_cells(pair.table, weighted, cells)
    return cells


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("given", ["scene 150", "scene 700", "real 7", *FEW])
def test_cells_are_those_of_the_grid_over_the_matches_of_weight(given: str, weighted: bool) -> None:
    for scale in SCALES if given in FEW else (1.0,):
        pair = named(given, scale)
        pair.match_weight[:3] *= 0
        points = pair.points32.astype(np.float64)
        inside = points[:, 3:] if weighted else points
        low, extent = inside.min(1, keepdims=True), np.ptp(inside, axis=1, keepdims=True)
        share = np.where(extent > 0, (points - low) / np.where(extent > 0, extent, 1), 0) * GRID
        clear = np.abs(share - np.round(share)) > 1e-4  # of a border: shares have an error of some 2^-20
        clear |= (share < 1e-9) | (share > GRID - 1e-9)  # cut off
        cell = np.clip(share, 0, GRID - 1).astype(int)
        cells = cells_of(pair, weighted) - [[0], [GRID * GRID]]
        for image in range(2):
            certain = clear[2 * image] & clear[2 * image + 1]
            assert given in FEW or certain.mean() > 0.99
            x, y = cell[2 * image, certain], cell[2 * image + 1, certain]
            np.testing.assert_array_equal(cells[image, certain], x + GRID * y)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("given", ["scene 150", "scene 700", "real 7", *FEW])
def test_scores_are_those_of_the_definition(given: str, weighted: bool) -> None:
    for scale in SCALES if given in FEW else (1.0,):
        pair = named(given, scale)
        bits, cells = fractional_bits(pair.count), cells_of(pair, weighted)
        weight = pair.match_weight.astype(np.float32).tolist() if weighted else [1.0] * pair.count
        F, which = models(pair, 8).astype(np.float32), np.array([5, 1, 2, 3, 4, 2])
        for threshold in {1.5, 1.5 * scale}:
            for k, total in zip(which, SaturatedGains(threshold, weighted)(F, which, pair), strict=True):
                r = residuals(F[k], pair, threshold)
                lower = [max(reference.geman_mcclure(x) - GAIN_ROUNDING, 0) for x in r.high]
                most = [reference.geman_mcclure(x) + GAIN_ROUNDING for x in r.low]
                bounds = [reference.saturated(gains, weight, cells, bits) for gains in (lower, most)]
                assert bounds[0] <= total <= bounds[1]


def test_sums_depend_on_no_order() -> None:
    """Of matches, whose sums within a cell are exact, and of models."""
    pair = pair_of(known(20_000))
    F, which, score = models(pair, 6).astype(np.float32), np.arange(6), SaturatedGains(20.0)
    total = score(F, which, pair)
    shuffled = pair.take(np.random.default_rng(0).permutation(pair.count))
    np.testing.assert_array_equal(score(F, which, shuffled), total)
    np.testing.assert_array_equal(score(F, which[::-1].copy(), pair), total[::-1])


def test_matches_of_no_weight_count_nothing() -> None:
    pair = named("scene 40")
    pair.match_weight[:] = 0
    F = models(pair, 4).astype(np.float32)
    assert SaturatedGains(1e6)(F, np.arange(1, 4), pair).tolist() == [0, 0, 0]


def test_saturation_prefers_what_explains_the_whole_image() -> None:
    """Of two pairs with as many inliers each, the one whose inliers lie in more cells scores higher."""
    spread = np.linspace(-0.9, 0.9, 128)
    crowd = np.where(np.arange(128) < 2, [-0.9, 0.9] * 64, 0.5)  # two in the corners span the same grid
    horizontal = np.array([[0, 0, -1, 0, 0, 0, 1, 0, 0]], np.float32)  # x1 - x0 = 0
    scores = []
    for x in (spread, crowd):
        pair = pair_of(known(128, "nothing"))
        pair.table[:4] = x
        scores.append(float(SaturatedGains(1.0)(horizontal, np.zeros(1, np.int64), pair)[0]))
    # On the diagonal of the grid there are 12 cells, one match in ten or eleven in each; against one of 126, and two.
    matches = np.bincount(np.minimum((spread + 0.9) / 1.8 * 12, 11).astype(int))
    assert scores[0] == pytest.approx(2 * np.sqrt(matches).sum(), abs=24 * 2.0**-11)
    assert scores[1] == pytest.approx(2 * (np.sqrt(126) + 2), abs=6 * 2.0**-11)


def test_a_threshold_must_be_positive() -> None:
    with pytest.raises(ValueError, match=r"threshold is 0.0; .* must be positive"):
        SaturatedGains(0.0)
