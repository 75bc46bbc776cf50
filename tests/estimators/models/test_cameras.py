"""Cameras near models: their F is the model where it is one of plausible cameras; else usual focal lengths."""

import numpy as np
import torch

from fmtorch.estimators.models.posterior import (
    centred,
    images_of,
    translate,
)
from tests.estimators.models.test_focals import TALL, WIDE, photographs
from tests.estimators.pairs import apart, frames, in_pixels, pair_of


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
