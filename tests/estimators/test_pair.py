"""From a batch to one pair: which matches are usable, in which units; and a model back in pixels."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences, collate
from fmtorch.estimators import Pair
from fmtorch.estimators.batch import Batch, relative_rounding
from fmtorch.estimators.pair import MAX_NOISE, MIN_NOISE, bucket
from tests.estimators.pairs import SCALES, known, named, pair_of, real
from tests.laws import degenerate, scene, small, with_padding
from tests.reference.random import number


def normalized(c: Correspondences, i: int = 0, minimal: int = 7) -> tuple[Pair, Any] | str:
    batch = Batch.of(c)
    with np.errstate(all="raise"):  # what overflows is no error of the caller's
        return batch.normalized(batch.pair(i), i, 0, minimal)


def padded_pairs() -> Correspondences:
    """Pairs of many sizes, with priors and noise on and beyond their bounds, with garbage in masked slots."""
    c = collate([scene(i, 7 + 67 * i, noise=0.1 * i) for i in range(6)])
    c = c.replace(noise=torch.linspace(1e-3, 40, c.mask.shape[1]).expand(len(c), -1))
    return with_padding(c, np.random.default_rng(1), float("nan"))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("kind", ["all", "nothing", "real"])
def test_a_pair_holds_its_usable_matches_in_order(kind: str, scale: float) -> None:
    c = real(7) if kind == "real" else padded_pairs()
    c = c if kind == "all" else c.replace(prior=None, noise=None, ratio=None, size0=None, size1=None)
    c = c.replace(x0=scale * c.x0.double(), x1=scale * c.x1.double())
    for i in range(len(c)):
        result = normalized(c, i)
        assert not isinstance(result, str)
        pair, slot = result
        mask = c.mask[i].numpy()
        np.testing.assert_array_equal(slot, np.flatnonzero(mask))
        pixels = torch.cat([c.x0, c.x1], -1)[i].numpy()[mask].T
        low, high = pixels.min(1), pixels.max(1)
        np.testing.assert_array_equal(pair.centre, (low + high) / 2)
        half = ((high - low) / 2).max()
        assert math.frexp(pair.pixels_per_unit)[0] == 0.5  # a power of two, the next one
        assert pair.pixels_per_unit / 2 < half <= pair.pixels_per_unit
        np.testing.assert_array_equal(pair.points, (pixels - pair.centre[:, None]) / pair.pixels_per_unit)
        assert (pair.count, pair.key, pair.bucket) == (mask.sum(), int(c.keys[i]), bucket(int(mask.sum())))
        values = {name: getattr(c, name) for name in ("prior", "noise", "ambiguity")}
        for name, value in values.items():
            assert (getattr(pair, name) is None) == (value is None) == (kind != "all")
        prior, noise, _ = (
            np.ones(pair.count) if value is None else value[i].double().numpy()[mask] for value in values.values()
        )
        noise = np.clip(noise, MIN_NOISE, MAX_NOISE)
        np.testing.assert_array_equal(pair.match_weight, prior)
        np.testing.assert_array_equal(pair.weight, prior / (noise * noise))
        np.testing.assert_array_equal(pair.pixels_per_noise, pair.pixels_per_unit / noise)
        assert pair.sizes.tolist() == ([640, 960, 640, 960] if kind == "all" else [])
        assert pair.sizes_known == (kind == "all")
        assert pair.table.flags.c_contiguous
        assert pair.table.dtype == np.float64


def test_the_unit_is_the_next_power_of_two() -> None:
    exact = [math.ldexp(1.0, e) for e in range(-300, 300, 7)]
    for unit in exact:
        for half, expected in (
            (math.nextafter(unit, 0), unit),
            (unit, unit),
            (math.nextafter(unit, math.inf), 2 * unit),
        ):
            x0 = torch.zeros(1, 8, 2, dtype=torch.float64)
            x0[0, 0, 0], x0[0, 1, 0] = half, -half
            result = normalized(Correspondences(x0, torch.zeros_like(x0), torch.ones(1, 8, dtype=torch.bool)))
            assert not isinstance(result, str)
            assert result[0].pixels_per_unit == expected


WRONG = {
    "prior": ((1.5, -0.1, math.nan), "prior of 1 match is wrong: it is P(inlier), within [0, 1]"),
    "noise": ((0.0, -1.0, math.nan), "noise of 1 match is wrong: it is a standard deviation, positive"),
    "size0": ((0.0, -3.0, math.nan, math.inf), "size0 is wrong: image sizes (h, w) are positive"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_values_are_a_reason_unless_they_are_masked(name: str) -> None:
    c, (values, reason) = known(20), WRONG[name]
    for value in values:
        wrong = getattr(c, name).float().clone()
        wrong[0, wrong.shape[1] // 2] = value
        assert normalized(c.replace(**{name: wrong})) == reason
        hidden = c.replace(**{name: wrong}, mask=torch.arange(20)[None] != 10)
        assert isinstance(normalized(hidden), str) == (name == "size0")


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e100, -1e300])
def test_matches_that_are_no_numbers_are_none(value: float) -> None:
    c = known(20)
    x1 = c.x1.double().clone()
    x1[0, 5, 1] = value
    result = normalized(c.replace(x0=c.x0.double(), x1=x1))
    assert not isinstance(result, str)
    np.testing.assert_array_equal(result[1], np.delete(np.arange(20), 5))
    few = normalized(c.replace(x0=c.x0.double(), x1=x1), minimal=20)
    assert few == "19 matches; at least 20 are needed"


def test_pairs_that_cannot_be_estimated_are_told_why() -> None:
    reasons = {name: normalized(c) for name, c in {**degenerate(), **small()}.items()}
    failures = {name: reason for name, reason in reasons.items() if isinstance(reason, str)}
    assert failures == {
        "empty": "0 matches; at least 7 are needed",
        "one match": "1 matches; at least 7 are needed",
        "all points equal": "all matches coincide",
        "NaN": "0 matches; at least 7 are needed",
        "infinite": "0 matches; at least 7 are needed",
        "8 coincident": "all matches coincide",
        "20 coincident": "all matches coincide",
    }


def test_a_pair_is_a_copy_and_its_neighbours_are_invisible() -> None:
    many, batch = padded_pairs(), Batch.of(padded_pairs())
    matches = batch.pair(3)
    pair = batch.normalized(matches, 3, 0, 7)[0]
    alone = normalized(many[[3]])[0]
    assert isinstance(pair, Pair)
    assert isinstance(alone, Pair)
    np.testing.assert_array_equal(pair.table, alone.table)
    before = matches.x0.copy()
    pair.table[:] = 0
    np.testing.assert_array_equal(matches.x0, before)


def test_a_part_of_a_pair_keeps_its_frame() -> None:
    pair = named("scene 40")
    index = np.array([7, 3, 30])
    part = pair.take(index)
    np.testing.assert_array_equal(part.table, pair.table[:, index])
    assert part.ambiguity is not None
    for name in ("bucket", "pixels_per_unit", "key", "seed", "centre", "sizes", "residual", "images"):
        assert getattr(part, name) is getattr(pair, name), name
    assert pair.cached("sum", lambda pair: float(pair.points.sum())) == pair.points.sum()
    assert pair.cached("sum", lambda pair: pytest.fail("computed again")) == pair.points.sum()
    assert part.cached("sum", lambda pair: float(pair.points.sum())) == part.points.sum()


def test_numbers_of_a_pair_are_those_of_its_seed_key_and_draw() -> None:
    pair = pair_of(scene(0, 20), seed=5)
    expected = [[(number(5, pair.key, 1, d, j, 4) >> 10) / 2**53 for j in range(4)] for d in range(100, 130)]
    assert pair.uniform(100, 30, 4).tolist() == expected


def test_the_rounding_of_coordinates() -> None:
    c = scene(0, 20)
    assert relative_rounding(c) == 2.0**-23
    assert relative_rounding(c.replace(x0=c.x0.double(), x1=c.x1.double())) == 2.0**-52
