"""Samples of five matches and drawn focal lengths, and what the assumption of plausible cameras is good for."""

import math

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.estimators.models.focal_prior import (
    FOCAL_DEVIATION,
    QUANTILES,
    RATIO_DEVIATION,
    SAME_CAMERA_SHARE,
    USUAL_FOCAL,
    draw_depths,
    normal_quantiles,
)
from fmtorch.estimators.models.posterior import images_of
from fmtorch.estimators.models.with_focals import FundamentalWithFocals
from fmtorch.jit.random import Stream
from fmtorch.metrics import nsgd
from tests.estimators.models.photographs import TALL, WIDE, Photographs, Sizes, photographs
from tests.estimators.pairs import pair_of
from tests.reference import random

SIZES = [(WIDE, WIDE), (WIDE, TALL)]


def error(F: torch.Tensor, pair: Photographs) -> float:
    """NSGD of the estimate (1, 3, 3)."""
    return float(nsgd(torch.from_numpy(pair.F)[None], F, pair.c.size0, pair.c.size1, key=pair.c.keys))


@pytest.mark.parametrize("sizes", SIZES)
def test_drawn_focal_lengths_are_functions_of_the_draw_that_follow_the_prior(sizes: Sizes) -> None:
    pair, seed, start, count = pair_of(photographs(0, sizes).c, 3), 3, 100, 4000
    images, depth, normal = images_of(pair), np.empty((2, count)), normal_quantiles()
    draw_depths(images.prior, images.longest, pair.mixed_seed(Stream.FOCAL), pair.key, start, depth)
    ratios = np.log(depth / images.longest[:, None])
    for d in range(20):
        words = [random.number(seed, pair.key, Stream.FOCAL, start + d, k, 3) % QUANTILES for k in range(3)]
        half = 0.0 if pair.same_size and words[2] < SAME_CAMERA_SHARE * QUANTILES else normal[words[1]]
        mean = math.log(USUAL_FOCAL) + FOCAL_DEVIATION * normal[words[0]]
        expected = [mean + RATIO_DEVIATION / 2 * half, mean - RATIO_DEVIATION / 2 * half]
        np.testing.assert_allclose(ratios[:, d], expected, atol=1e-12)
    # Four standard errors of 4000 draws (of 1200 ratios).
    mean, difference = ratios.mean(0), ratios[0] - ratios[1]
    assert mean.mean() == pytest.approx(math.log(1.2), abs=4 * 0.4 / math.sqrt(count))
    assert mean.std() == pytest.approx(0.4, abs=4 * 0.4 / math.sqrt(2 * count))
    equal = float((np.abs(difference) < 1e-12).mean())  # of a normal ratio one draw in 1e12
    assert equal == pytest.approx(0.7 if pair.same_size else 0.0, abs=4 * math.sqrt(0.7 * 0.3 / count))
    other = difference[np.abs(difference) >= 1e-12]
    assert other.std() == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(2 * len(other)))


def test_quantiles_are_those_of_the_normal_distribution() -> None:
    normal = normal_quantiles()
    shares = [0.5 * math.erfc(-q / math.sqrt(2)) for q in normal.tolist()]
    np.testing.assert_allclose(shares, (np.arange(QUANTILES) + 0.5) / QUANTILES, atol=2.0**-40)


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


def test_unknown_sizes_are_searched_without_assumptions() -> None:
    pair = photographs(2, (WIDE, WIDE), (1.0, 1.0), 300, noise=0.5)
    bare = pair.c.replace(size0=None, size1=None)
    estimate = presets.build("estimator", "fmtorch")(bare, 0)
    assert bool(estimate.ok[0])
    assert torch.equal(estimate.F, presets.build("estimator", "fmtorch", focal=None)(bare, 0).F)
    assert error(estimate.F, pair) < 0.05
