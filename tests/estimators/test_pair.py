"""A pair: its usable matches in normalised units, the way back to pixels, and why it cannot be estimated."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from fmtorch.core.streams import Stream
from fmtorch.core.types import Correspondences, collate
from fmtorch.estimators.batch import Batch
from fmtorch.estimators.pair import MAX_NOISE, MIN_NOISE, Pair, bucket, power_of_two, to_pixels
from fmtorch.geometry.pixel_frame import PixelFrame
from tests.estimators.pairs import pair_of
from tests.laws import scene, with_padding
from tests.reference.random import number


def at_the_door(c: Correspondences, i: int = 0, minimal: int = 7) -> tuple[Pair, np.ndarray] | str:
    batch = Batch.of(c)
    return batch.normalized(batch.pair(i), i, 0, minimal)


def test_usable_matches_come_first_in_units_of_a_power_of_two() -> None:
    c = with_padding(collate([scene(0, 40), scene(1, 90)]), np.random.default_rng(1), float("nan"))
    c = c.replace(noise=torch.linspace(1e-3, 40, c.mask.shape[1]).expand(len(c), -1).contiguous())
    c.x0[0, 5] = torch.inf
    normalized = at_the_door(c)
    assert not isinstance(normalized, str)
    pair, slot = normalized
    usable = (c.mask[0] & c.x0[0].isfinite().all(-1)).nonzero()[:, 0].numpy()
    np.testing.assert_array_equal(slot, usable)
    pixels = torch.cat([c.x0[0], c.x1[0]], -1).double().numpy()[usable].T
    np.testing.assert_array_equal(pair.points * pair.pixels_per_unit + pair.centre[:, None], pixels)
    assert math.log2(pair.pixels_per_unit).is_integer()
    assert 0.5 < np.abs(pair.points).max() <= 1
    assert c.prior is not None
    assert c.noise is not None
    assert c.quality is not None
    noise = c.noise[0].double().numpy()[usable].clip(MIN_NOISE, MAX_NOISE)
    prior = c.prior[0].double().numpy()[usable]
    for name, expected in (
        ("weight", prior / noise**2), ("pixels_per_noise", pair.pixels_per_unit / noise), ("match_weight", prior),
        ("noise", noise), ("quality", c.quality[0].double().numpy()[usable]),
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(pair, name), expected, err_msg=name)


def test_what_is_not_known() -> None:
    pair = pair_of(scene(0, 40).replace(prior=None, noise=None, quality=None, size0=None, size1=None))
    assert (pair.prior, pair.noise, pair.quality, pair.sizes_known) == (None, None, None, False)
    np.testing.assert_array_equal(pair.weight, np.ones(40))
    np.testing.assert_array_equal(pair.match_weight, np.ones(40))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"prior": 1.5}, "prior of 1 match is wrong: it is P(inlier), within [0, 1]"),
        ({"prior": torch.nan}, "prior of 1 match is wrong: it is P(inlier), within [0, 1]"),
        ({"noise": 0.0}, "noise of 1 match is wrong: it is a standard deviation, positive"),
        ({"size0": 0}, "size0 is wrong: image sizes (h, w) are positive"),
    ],
)
def test_wrong_values_are_a_reason(change: dict[str, float], reason: str) -> None:
    c = scene(0, 40)
    c = c.replace(noise=torch.ones(1, 40))
    ((name, value),) = change.items()
    values = getattr(c, name).clone()
    values[0, 3 if values.shape[1] > 2 else 0] = value
    assert at_the_door(c.replace(**{name: values})) == reason


def test_reasons_of_degenerate_pairs() -> None:
    assert at_the_door(scene(0, 6)) == "6 matches; at least 7 are needed"
    coincident = scene(0, 20)
    assert at_the_door(coincident.replace(x0=coincident.x0 * 0, x1=coincident.x1 * 0)) == "all matches coincide"
    far = coincident.replace(x0=coincident.x0.double() * 1e149)
    assert at_the_door(far) == "0 matches; at least 7 are needed"


@pytest.mark.parametrize(
    ("count", "size"), [(1, 128), (128, 128), (129, 192), (192, 192), (193, 256), (760, 768), (769, 1024)]
)
def test_buckets(count: int, size: int) -> None:
    assert bucket(count) == size


@pytest.mark.parametrize("half", [1e-300, 0.3, 0.5, 1.0, 1.0000001, 1023.9, 1024.0, 3e100])
def test_the_unit_is_the_next_power_of_two(half: float) -> None:
    unit = float(power_of_two(half))
    assert half <= unit < 2 * half
    assert math.frexp(unit)[0] == 0.5
    points = torch.tensor([[[0.0, 0, 0, 0], [2 * half, 0, 0, 0]]], dtype=torch.float64)
    assert float(PixelFrame.around(points, torch.ones(1, 2, dtype=torch.bool)).pixels_per_unit) == unit


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_a_model_goes_back_to_pixels(scale: float) -> None:
    c = scene(0, 30)
    c = c.replace(x0=c.x0.double() * scale, x1=c.x1.double() * scale)
    pair = pair_of(c)
    rng = np.random.default_rng(0)
    for _ in range(5):
        F, out = rng.normal(size=9), np.empty((3, 3))
        assert to_pixels(F, pair.centre, pair.pixels_per_unit, out)
        points = np.concatenate([pair.points, np.ones((1, pair.count))])
        unit_error = np.einsum("in,ij,jn->n", points[[2, 3, 4]], F.reshape(3, 3), points[[0, 1, 4]])
        x0, x1 = (np.c_[x[0].numpy(), np.ones(30)] for x in (c.x0, c.x1))
        error = np.einsum("ni,ij,nj->n", x1, out, x0)
        ratio = error @ unit_error / (unit_error @ unit_error)
        size = np.abs(x1) @ np.abs(out) * np.abs(x0)  # what an error cancels from
        assert (np.abs(error - ratio * unit_error) <= 64 * 2**-53 * size.sum(1)).all()
        assert abs(np.linalg.norm(out) - 1) < 1e-15 * 9
        assert out.ravel()[np.abs(out).argmax()] > 0
    assert not to_pixels(np.full(9, np.nan), pair.centre, pair.pixels_per_unit, np.empty((3, 3)))


def test_uniform_numbers_are_those_of_the_definition() -> None:
    pair = pair_of(scene(0, 30), 9)
    expected = [[number(9, pair.key, Stream.SAMPLING, d, k, 3) >> 10 for k in range(3)] for d in range(50, 54)]
    np.testing.assert_array_equal(pair.uniform(50, 4, 3), np.array(expected) * 2.0**-53)


def test_what_a_part_computes_is_kept_with_the_matches() -> None:
    pair = pair_of(scene(0, 30))
    first = pair.cached("ones", lambda pair: np.ones(pair.count))
    assert pair.cached("ones", lambda pair: pytest.fail("computed again")) is first
    subset = pair.take(np.array([3, 1]))
    assert len(subset.cached("ones", lambda pair: np.ones(pair.count))) == 2
    np.testing.assert_array_equal(subset.points, pair.points[:, [3, 1]])
    assert subset.bucket == pair.bucket
