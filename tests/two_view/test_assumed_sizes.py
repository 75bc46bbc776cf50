"""Image sizes that nobody gave: what `find_fundamental` assumes of them, and what it says of that."""

import re
from typing import Any

import cv2 as opencv
import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import cv2
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.two_view.assumed_sizes import extents
from tests.reference import assumed_sizes, known_cameras

SIZE = known_cameras.SIZE


def found(x0: Any, x1: Any, **said: Any) -> Estimate:
    return fmtorch.find_fundamental(x0, x1, hypotheses=200, **said)


def points(seed: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Matches all over two photographs of one camera, a quarter of them wrong, image 1 enlarged so much."""
    rng, K = np.random.default_rng(seed), np.array([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1.0]])
    X = np.c_[rng.uniform(-4, 4, (900, 2)), rng.uniform(4, 6, 900)] @ K.T
    moved = X + K @ [-0.6, 0.1, 0.3] + rng.normal(0, 0.5, X.shape)
    x0, x1 = X[:, :2] / X[:, 2:], moved[:, :2] / moved[:, 2:]
    inside = ((x0 >= 0) & (x1 >= 0) & (x0 < SIZE[::-1]) & (x1 < SIZE[::-1])).all(1)
    x0, x1 = x0[inside], scale * x1[inside]
    x1[: len(x1) // 4] = rng.permutation(x1[: len(x1) // 4])
    return x0, x1


def batch(pairs: list[tuple[np.ndarray, np.ndarray]]) -> Correspondences:
    """Padded by points that would tell another size."""
    n = max(len(x0) for x0, _ in pairs)
    padded = [[np.concatenate([x, np.full((n - len(x), 2), 9e4)]) for x in pair] for pair in pairs]
    x0, x1 = (torch.from_numpy(np.stack(x)) for x in zip(*padded, strict=True))
    return Correspondences(x0, x1, torch.arange(n) < torch.tensor([[len(x)] for x, _ in pairs]))


def test_extents_are_those_of_the_reference() -> None:
    x0, x1 = points(0)
    far = x1.copy()
    far[3] = np.inf
    pairs = [(x0, x1), (x0[:19], x1[:19]), (x0 - 300, x1), (x0, far), (x0, x1 / 100), points(1, 0.6)]
    sizes, known = extents(batch(pairs))
    for i, pair in enumerate(pairs):
        expected = assumed_sizes.extents(*pair)
        assert bool(known[i]) == (expected is not None)
        if expected is not None:
            torch.testing.assert_close(sizes[i], torch.tensor(expected, dtype=torch.float64), rtol=1e-15, atol=0)


def test_the_estimate_is_that_of_the_sizes_that_are_assumed() -> None:
    x0, x1 = points(0)
    estimate = found(x0, x1)
    assert estimate.sizes is not None
    (size, other), said = estimate.sizes[0], assumed_sizes.extents(x0, x1)
    assert said is not None
    assert size.tolist() == other.tolist() == pytest.approx(assumed_sizes.assumed(said, 0, 0)[0][0])
    assert (size > torch.tensor(SIZE) * 0.9).all()
    assert (size < torch.tensor(SIZE) * 1.1).all()
    assert torch.equal(estimate.F, found(x0, x1, size0=size, size1=size).F)
    assert not torch.equal(estimate.F, found(x0, x1, size0="unknown").F)
    assert estimate.warning == ("",)


@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_images_of_one_size_or_of_two_by_their_significance(scale: float) -> None:
    x0, x1 = points(1, scale)
    x0, x1 = (x0[x0[:, 0] < 320], x1[x0[:, 0] < 320]) if scale == 1 else (x0, x1)
    own = assumed_sizes.extents(x0, x1)
    assert own is not None
    same = [max(size) for size in zip(*own, strict=True)]
    both = [found(x0, x1, size0=size0, size1=size1) for size0, size1 in ((same, same), own)]
    sizes, doubtful = assumed_sizes.assumed(own, *(float(e.significance[0]) for e in both))
    estimate = found(x0, x1)
    assert doubtful
    assert estimate.sizes is not None
    assert estimate.sizes[0].tolist() == pytest.approx(np.array(sizes), rel=1e-15)
    assert any(torch.equal(estimate.F, e.F) for e in both)
    assert "give size0 and size1, or 'unknown'" in estimate.warning[0]


def test_pairs_keep_to_themselves() -> None:
    x0, x1 = points(0)
    wide, upright = x0[:, 0] < 320, points(2, 0.6)
    pairs = [(x0, x1), (x0 - 300, x1 - 300), (x0[wide], x1[wide]), upright, (x0[:9], x1[:9])]
    together = found([x for x, _ in pairs], [x for _, x in pairs])
    assert together.sizes is not None
    for i, pair in enumerate(pairs):
        alone = found(*pair)
        assert torch.equal(together.F[i], alone.F[0])
        assert torch.equal(together.inliers[i, : len(pair[0])], alone.inliers[0])
        assert alone.sizes is not None
        assert torch.equal(together.sizes[i].nan_to_num(), alone.sizes[0].nan_to_num())
    for i in (1, 4):  # nothing is assumed
        assert together.sizes[i].isnan().all()
        assert torch.equal(together.F[i], found(*pairs[i], size0="unknown").F[0])
    assert [bool(warning) for warning in together.warning] == [False, False, True, True, False]
    assert len(found([], [])) == 0


def test_gradients_are_those_of_the_assumed_sizes() -> None:
    x0, x1 = (torch.from_numpy(x).requires_grad_() for x in points(0))
    estimate = found(x0, x1)
    assert estimate.sizes is not None
    size, weight = estimate.sizes[0, 0].detach(), torch.arange(9.0, dtype=torch.float64).reshape(3, 3)
    (given,) = torch.autograd.grad((found(x0, x1, size0=size, size1=size).F * weight).sum(), x0)
    (assumed,) = torch.autograd.grad((estimate.F * weight).sum(), x0)
    assert assumed.abs().max() > 0
    assert torch.equal(assumed, given)


def test_opencv_is_given_them_unasked() -> None:
    x0, x1 = points(0)
    F, _ = cv2.findFundamentalMat(x0, x1, opencv.FM_RANSAC, 3.0)
    assert F is not None
    expected = fmtorch.find_fundamental(x0, x1, inlier_threshold=3.0)
    assert expected.sizes is not None
    np.testing.assert_allclose(F / np.linalg.norm(F), expected.F[0].numpy(), atol=1e-12)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"size0": "guess"}, "size0 is 'guess'; it must be (h, w), 'unknown' or None"),
        ({"size0": SIZE, "size1": "unknown"}, "size0 is given and the other is 'unknown'"),
        ({"size0": "unknown", "size1": SIZE}, "size1 is given and the other is 'unknown'"),
        ({"size0": "unknown", "focal": "shared"}, "focal needs the image sizes"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(said: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        found(*points(0), **said)


def test_other_estimators_assume_nothing() -> None:
    x0, x1 = points(0)
    assert fmtorch.find_fundamental(x0, x1, estimator="ransac").sizes is None
    assert found(x0, x1, size0=SIZE, size1=SIZE).sizes is None
