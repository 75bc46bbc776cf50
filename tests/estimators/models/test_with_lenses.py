"""The posterior of two cameras with lenses: residuals, derivatives, and its maximum."""

from __future__ import annotations

import numpy as np
import torch

from fmtorch.core import Correspondences
from fmtorch.estimators import Pair
from fmtorch.estimators.lens_search import (
    undistorted,
)
from tests.estimators.pairs import pair_of
from tests.reference import lenses as reference

SIZE = (480, 640)


LENSES = (-0.2, -0.1)


def bent_pair(lenses: tuple[float, float] = LENSES) -> tuple[Pair, np.ndarray, np.ndarray]:
    """A pair, its matches (n, 4) in pixels, and F of pinholes."""
    x0, x1, F, _ = reference.photographs(0, lenses, SIZE, wrong=0)
    c = Correspondences(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], torch.ones(1, len(x0), dtype=torch.bool),
        size0=torch.tensor([SIZE]), size1=torch.tensor([SIZE]),
    )  # fmt: skip
    return pair_of(c), np.c_[x0, x1], F


def test_undistorted_points_are_the_reference_s() -> None:
    pair, x, _ = bent_pair()
    points = undistorted(pair, np.array(LENSES)).points.T * pair.pixels_per_unit + pair.centre
    for i in range(2):
        expected = [reference.straight(each, SIZE, LENSES[i]) for each in x[:, 2 * i : 2 * i + 2]]
        np.testing.assert_allclose(points[:, 2 * i : 2 * i + 2], expected, atol=1e-9)
