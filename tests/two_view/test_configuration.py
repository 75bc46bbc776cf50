"""Configurations of estimated pairs: synthetic ones of each kind, known and unknown cameras, the laws, arguments."""

import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core import PAIR_TYPES, Correspondences, Estimate, collate
from fmtorch.two_view.pair_type import classify
from tests.geometry.scenes import batch, draw


def pair(kind: str, seed: int, n: int = 150, **options: float) -> Correspondences:
    given = batch([draw(kind, seed, n, **options)])  # type: ignore[arg-type]
    fields = {name: given[name] for name in ("x0", "x1", "mask", "size0", "size1", "K0", "K1")}
    return Correspondences(**fields, key=torch.tensor([seed]))


def estimated(c: Correspondences) -> Estimate:
    estimate: Estimate = presets.build("estimator", "fmtorch")(c, 0)
    return estimate


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("kind", PAIR_TYPES)
def test_kinds(kind: str, known: bool) -> None:
    """Of estimated models, with calibrations and by image sizes alone, the cameras being usual ones."""
    c = collate([pair(kind, seed) for seed in range(20)])
    c = c if known else c.replace(K0=None, K1=None)
    classified = classify(c, estimated(c))
    assert classified.names.count(kind) >= 19, classified.names
    assert torch.equal(classified.determined, torch.tensor([name == "general" for name in classified.names]))
    exact = classify(c, estimated(c), focal_deviation=0)
    assert exact.names.count(kind) >= 19, exact.names


def test_a_focal_length_that_is_not_known_is_that_of_no_calibration() -> None:
    """Rotations with K whose focal lengths are three times too long, and with measured ones but no K."""
    pairs = [pair("rotation", seed) for seed in range(10)]
    c = collate(pairs)
    long = torch.tensor([3.0, 3.0, 1.0])
    wrong, estimate = c.replace(K0=c.K0 * long, K1=c.K1 * long), estimated(c)
    assert classify(wrong, estimate).names.count("rotation") <= 2
    unknown = wrong.replace(focal=torch.tensor([1.0, torch.inf]).expand(len(c), 2, 2).clone())
    assert classify(unknown, estimate).names.count("rotation") >= 8
    px = torch.stack([c.K0[:, 0, 0], c.K1[:, 0, 0]], 1)
    measured = torch.stack([px, torch.full_like(px, 0.01)], -1)
    assert classify(c.replace(K0=None, K1=None, focal=measured), estimate).names.count("rotation") >= 9


def test_a_rotation_needs_cameras_or_sizes() -> None:
    c = pair("rotation", 0)
    assert classify(c, estimated(c)).names == ("rotation",)
    c = c.replace(K0=None, K1=None, size0=None, size1=None)
    assert classify(c, estimated(c)).names == ("planar",)


def test_laws() -> None:
    few = pair("general", 9, 5)
    pairs = [pair(kind, i, 60 + 31 * i) for i, kind in enumerate(PAIR_TYPES)]
    c = collate([*pairs[:3], few, *pairs[3:]])
    classified = classify(c, estimated(c))
    assert classified.names == (*PAIR_TYPES[:3], "unrelated", *PAIR_TYPES[3:])
    for i, single in enumerate([*pairs[:3], few, *pairs[3:]]):
        alone = classify(single, estimated(single))
        for a, b in zip((alone.kind, *alone.evidence), (classified.kind, *classified.evidence), strict=True):
            assert torch.equal(a[0], b[i])


def test_wrong_arguments() -> None:
    c = pair("general", 0)
    estimate = estimated(c)
    with pytest.raises(ValueError, match=r"estimate is of homography matrices"):
        classify(c, fmtorch.find_homography(c.x0, c.x1))
    with pytest.raises(ValueError, match=r"estimate is of 0 pairs and c of 1"):
        classify(c, estimate[:0])
    with pytest.raises(ValueError, match=r"focal_deviation is -1"):
        classify(c, estimate, focal_deviation=-1)
