"""The door and the exit of one pair against those of tensors: the same reasons, and the same numbers to the bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators import support, support_kernels
from fmtorch.estimators.one_pair import exit as compiled
from fmtorch.estimators.pairs_kernels import power_of_two
from fmtorch.estimators.support import lack_of_support
from fmtorch.geometry.pixel_frame import PixelFrame
from tests.laws import degenerate, scene, small, with_padding

pytest.importorskip("numba", reason="numba is not installed")


def told() -> Correspondences:
    """Pairs of many sizes, with priors and noise on and beyond their bounds, with garbage in masked slots."""
    c = collate([scene(i, 7 + 67 * i, noise=0.1 * i) for i in range(6)])
    c = c.replace(noise=torch.linspace(1e-3, 40, c.mask.shape[1]).expand(len(c), -1))
    return with_padding(c, np.random.default_rng(1), float("nan"))


def wrong() -> Correspondences:
    """Pairs each of which has something that cannot be used."""
    c = told()[[1, 1, 2, 2, 3, 3, 4, 4]]
    c = c.replace(**{name: getattr(c, name).clone() for name in ("x0", "x1", "prior", "noise", "size0")})
    assert c.prior is not None
    assert c.noise is not None
    assert c.size0 is not None
    k = int(c.mask.all(0).nonzero()[0])
    c.prior[0, k], c.prior[1, k], c.noise[2, k], c.size0[3] = 1.5, torch.nan, 0, 0
    c.x0[4, k], c.x1[5, k] = torch.nan, torch.inf
    c.x0[6], c.x1[7] = 1e-20, 3.0
    return c


SETS = {
    "scenes": told,
    "wrong": wrong,
    "degenerate": lambda: collate([*degenerate().values(), *small().values()]),
    "nothing known": lambda: told().replace(prior=None, noise=None, quality=None, size0=None, size1=None),
    "huge": lambda: (lambda c: c.replace(x0=c.x0.double() * 1e149, x1=c.x1.double() * 1e-140))(told()),
}


@pytest.mark.parametrize("name", SETS)
def test_an_estimate_is_that_of_the_tensor_door(name: str) -> None:
    c = SETS[name]()
    estimator = presets.build("estimator", "msac", hypotheses=60, round=30)
    with np.errstate(all="raise"):  # what overflows is no error of the caller's
        ours = estimator(c, 3)
    theirs = estimator(c.replace(x0=c.x0.clone().requires_grad_()), 3)
    assert ours.reason == theirs.reason
    for field in ("F", "inliers", "ok", "draws", "significance"):
        assert torch.equal(getattr(ours, field), getattr(theirs, field).detach()), field
    assert bool(ours.ok.any()) == (name != "huge")


def test_constants_are_those_of_the_tensor_form() -> None:
    for name in ("ROUNDINGS", "EXTENT_ROUNDING", "DIRECTION"):
        assert getattr(support_kernels, name) == getattr(support, name), name


def test_support_is_told_alike() -> None:
    rng = np.random.default_rng(0)
    points, inliers = rng.uniform(-1, 1, (4, 60, 300)), rng.random((60, 300)) < 0.5
    rounding = 2.0 ** -rng.integers(10, 50, 60)
    for i in range(60):
        if i % 3:  # up to the 256th, or throughout
            points[1, i, : 300 if i % 2 else 256] = points[0, i, : 300 if i % 2 else 256] / 3
        if i % 4 == 1:
            points[3, i] = 0.1 * points[2, i] + rng.normal(0, rounding[i], 300)
        if i % 5 == 0:
            inliers[i, rng.integers(2, 9) :] = False
        if i % 5 == 1:
            points[:, i] = points[:, i, rng.integers(0, 1 + i // 5, 300)]
    expected = lack_of_support(*(torch.from_numpy(x) for x in (points, inliers)), 7, torch.from_numpy(rounding))
    found = [
        compiled.lack_of_support(np.ascontiguousarray(points[:, i]), inliers[i], 7, rounding[i]) for i in range(60)
    ]
    assert found == expected
    assert len(set(found)) > 6


def test_the_unit_is_the_next_power_of_two() -> None:
    exact = [math.ldexp(1.0, e) for e in range(-900, 330, 7)]
    halves = [value for one in exact for value in (math.nextafter(one, 0), one, math.nextafter(one, math.inf))]
    box = torch.tensor([[0, 0, -1, 0], [0, 0, 1, 0]], dtype=torch.float64)
    pixels = torch.tensor(halves, dtype=torch.float64)[:, None, None] * box
    frame = PixelFrame.around(pixels, torch.ones(pixels.shape[:2], dtype=torch.bool))
    assert frame.pixels_per_unit.tolist() == [power_of_two(half) for half in halves]
    units = [unit for one in exact for unit in (one, one, 2 * one)]
    assert frame.pixels_per_unit.tolist() == units
