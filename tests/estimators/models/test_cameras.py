"""Cameras near models: their F is the model where it is one of plausible cameras; else usual focal lengths."""

import math

import numpy as np
import pytest
import torch

from fmtorch.estimators import Pair
from fmtorch.estimators.models.focal_prior import LOG_USUAL
from fmtorch.estimators.models.posterior import (
    Cameras,
    centred,
    images_of,
    nearest_cameras,
    no_cameras,
    tangents_of,
    translate,
)
from tests.estimators.models.photographs import TALL, WIDE, photographs
from tests.estimators.pairs import apart, frames, in_pixels, pair_of, to_units
from tests.reference import focal as reference


def near(F: np.ndarray, pair: Pair) -> Cameras:
    """The cameras near models (k, 9) of a pair's points."""
    cameras = no_cameras(len(F))
    nearest_cameras(F, images_of(pair), cameras)
    return cameras


def models_of(cameras: Cameras, pair: Pair) -> np.ndarray:
    """Their fundamental matrices (k, 9), of a pair's points."""
    k, images = len(cameras.focal), images_of(pair)
    F, moved = np.empty((k, 9)), np.empty((k, 9))
    tangents_of(cameras, images.longest, F, np.zeros((k, 9, 8)))
    translate(F, images.offset, moved)
    return moved


@pytest.mark.parametrize("sizes", [(WIDE, WIDE), (WIDE, TALL)])
def test_cameras_of_a_model_are_those_that_made_it(sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    for seed in range(8):
        focal = tuple(np.random.default_rng(seed).uniform(0.6, 3, 2).tolist())
        c, truth, _ = photographs(seed, sizes, focal)
        pair = pair_of(c)
        F = to_units(truth, pair)
        cameras = near(F[None], pair)
        # Bougnoux's formula loses the digits in which the axes' planes differ, 1e3 here at most, and its root half.
        np.testing.assert_allclose(np.exp(cameras.focal[0]), focal, rtol=1e-8)
        assert apart(models_of(cameras, pair)[0], F) < 1e-9
        for axes in cameras.axes[0]:
            np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)


def test_implausible_focal_lengths_are_replaced_by_usual_ones() -> None:
    c, _, parameters = photographs(0)
    pair = pair_of(c)
    for first, second in ((0.2, 1.0), (1.0, 5.5), (0.1, 9.0)):
        strange = np.concatenate([parameters[:6], np.log([first, second])])
        cameras = near(to_units(reference.fundamental(strange, WIDE, TALL), pair)[None], pair)
        assert cameras.focal[0].tolist() == [LOG_USUAL, LOG_USUAL]
        for axes in cameras.axes[0]:
            np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert pytest.approx(math.log(1.2)) == LOG_USUAL


def test_points_from_the_principal_points_and_the_scale_of_a_loss() -> None:
    c, truth, _ = photographs(1)
    noise = np.random.default_rng(0).uniform(0.5, 2, (1, 200))
    pair = pair_of(c.replace(noise=torch.from_numpy(noise)))
    matches, images = centred(pair, 0.7), images_of(pair)
    pixels = np.concatenate([c.x0[0].numpy(), c.x1[0].numpy()], 1).T
    principal = np.array([(WIDE[1] - 1) / 2, (WIDE[0] - 1) / 2, (TALL[1] - 1) / 2, (TALL[0] - 1) / 2])
    expected = (pixels - principal[:, None]) / pair.pixels_per_unit
    np.testing.assert_allclose(matches.points, expected, atol=1e-14)
    np.testing.assert_allclose(matches.s2, (0.7 * noise[0] / pair.pixels_per_unit) ** 2, rtol=1e-14)
    np.testing.assert_allclose(matches.precision, 1 / matches.s2, rtol=1e-14)
    np.testing.assert_allclose(images.longest * pair.pixels_per_unit, [960, 1000])
    # A model of points from the principal points, moved to those from the centre.
    A0, A1 = frames(pair)
    shifted = [A.copy() for A in (A0, A1)]
    shifted[0][:2, 2], shifted[1][:2, 2] = principal[:2], principal[2:]
    G, moved = (shifted[1].T @ truth @ shifted[0]).reshape(1, 9), np.empty((1, 9))
    translate(G, images.offset, moved)
    assert apart(in_pixels(moved[0], pair), truth) < 1e-12
