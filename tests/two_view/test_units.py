"""Points that are obviously not in pixels are refused, with what to do; what may be in pixels is not."""

import warnings

import numpy as np
import pytest
import torch

import fmtorch
from tests.reference.known_cameras import K0, K1, SIZE, angle, scene

SCENE = scene(0)
X0, X1 = SCENE.x0, SCENE.x1


def normalized(x: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Points by their calibration matrix."""
    return (np.c_[x, np.ones(len(x))] @ np.linalg.inv(K).T)[:, :2]


@pytest.mark.parametrize("unit", ["focal length", "width", "0 to 1", "-1 to 1"])
def test_normalized_points_are_refused(unit: str) -> None:
    """They came back ok, with all matches inliers: thresholds are in pixels."""
    if unit == "focal length":
        x0, x1 = normalized(X0, K0), normalized(X1, K1)
    else:
        scale, shift = {"width": (640, 0.5), "0 to 1": (640, 0), "-1 to 1": (320, 1)}[unit]
        x0, x1 = (x / scale - shift for x in (X0, X1))
    for find in (fmtorch.find_fundamental, fmtorch.find_homography):
        for points in ((x0, x1), (np.stack([x0, x0]), np.stack([x1, x1]))):
            with pytest.raises(
                ValueError, match=r"^x0 runs from .*: no pixels, in which thresholds are.*Give points in"
            ):
                find(*points)


def test_normalized_points_have_the_identity_for_their_camera() -> None:
    x0, x1 = normalized(X0, K0), normalized(X1, K1)
    estimate = fmtorch.find_essential(x0, x1, np.eye(3), np.eye(3))
    assert bool(estimate.ok)
    assert int(estimate.inliers.sum()) < 0.8 * len(x0)
    with_pair_type = fmtorch.find_essential(x0, x1, np.eye(3), np.eye(3), pair_type=True)
    assert with_pair_type.pair_type == ("general",)
    with pytest.raises(
        ValueError, match=r"x0 runs from .*, as normalised points do, but K0 is in pixels; give points in"
    ):
        fmtorch.find_essential(x0, x1, K0, K1)


def test_one_image_may_be_the_wrong_one() -> None:
    with pytest.raises(ValueError, match=r"^x1 runs from"):
        fmtorch.find_fundamental(X0, normalized(X1, K1))


def test_sizes_that_contradict_the_points() -> None:
    with pytest.raises(
        ValueError, match=r"size1 is \(640, 480\), but .* sizes are \(h, w\), and it looks like \(w, h\)"
    ):
        fmtorch.find_fundamental(X0, X1, size0=SIZE[::-1], size1=SIZE[::-1])
    with pytest.raises(ValueError, match=r"size1 is \(48, 64\), but .* % of x1 lie outside such an image"):
        fmtorch.find_fundamental(X0, X1, size0=SIZE, size1=(48, 64))
    assert bool(fmtorch.find_fundamental(X0, X1, size0=SIZE, size1=SIZE).ok)


def test_points_of_a_wide_lens_are_no_swapped_sizes() -> None:
    """Undistorted, most lie outside on all sides; points from the principal point lie there, too, but never beyond."""
    from_centre = [(x - (319.5, 239.5)) for x in (X0, X1)]
    far = [(x - (319.5, 239.5)) * 4 + (319.5, 239.5) for x in (X0, X1)]
    assert bool(fmtorch.find_fundamental(*far, size0=SIZE, size1=SIZE).ok)
    with pytest.raises(ValueError, match=r"size0 is \(480, 640\), but .* % of x0 lie outside such an image"):
        fmtorch.find_fundamental(*from_centre, size0=SIZE, size1=SIZE)


def part(corner: tuple[float, float], size: tuple[int, int]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The matches whose both points are in a crop of the images, in its pixels, and its calibrations."""
    h, w = size
    x0, x1 = SCENE.x0 - corner, SCENE.x1 - corner
    inside = ((x0 >= 0) & (x0 < (w, h)) & (x1 >= 0) & (x1 < (w, h))).all(1)
    shift = np.array([[0, 0, corner[0]], [0, 0, corner[1]], [0, 0, 0]])
    return [x0[inside], x1[inside]], [K0 - shift, K1 - shift]


@pytest.mark.parametrize("sizes", [{}, {"size0": (480, 300), "size1": (480, 300)}])
def test_the_principal_point_of_a_crop_may_lie_outside(sizes: dict[str, tuple[int, int]]) -> None:
    """The pose is that of the whole images, alone and in a batch, and nothing is said against K."""
    (x0, x1), Ks = part((340, 0), (480, 300))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = fmtorch.find_essential(x0, x1, *Ks, **sizes)
        batch = fmtorch.find_essential([x0, x0[:40]], [x1, x1[:40]], *Ks, **sizes)
    assert angle(alone.R[0].numpy(), SCENE.R) < 0.5
    assert alone.warning == ("",)
    assert torch.equal(batch.R[0], alone.R[0])
    assert bool(batch.ok.all())


def test_calibrations_of_another_resolution_are_doubted() -> None:
    """Their pose is off by many degrees, though some matches agree with it."""
    quarter = [np.diag([0.25, 0.25, 1]) @ K for K in (K0, K1)]
    for sizes in ({}, {"size0": SIZE, "size1": SIZE}):
        with pytest.warns(UserWarning, match="pair 0: far more matches agree without the calibration matrices"):
            wrong = fmtorch.find_essential(X0, X1, *quarter, **sizes)
        assert "another resolution" in wrong.warning[0]
        assert angle(wrong.R[0].numpy(), SCENE.R) > 2
    both = [[K, wrong] for K, wrong in zip((K0, K1), quarter, strict=True)]
    with pytest.warns(UserWarning, match="^pair 1: "):
        batch = fmtorch.find_essential([X0, X0], [X1, X1], *both, pair_type=True)
    assert batch.warning[0] == ""
    assert "another resolution" in batch.warning[1]


def test_pairs_of_a_batch_stand_for_one_another() -> None:
    """No pair takes its batch down: a small patch of an image may happen, a batch of normalised ones is a mistake."""
    small = 5 + normalized(X0, K0), 5 + normalized(X1, K1)
    both = fmtorch.find_fundamental(np.stack([X0, small[0]]), np.stack([X1, small[1]]))
    assert bool(both.ok[0])
    assert bool((both.F[:1] == fmtorch.find_fundamental(X0, X1).F).all())


def test_what_says_nothing_is_no_mistake() -> None:
    """Points that coincide, too few of them, none that is real: pairs that fail with a reason."""
    zeros, few = np.zeros((20, 2)), normalized(X0[:6], K0)
    for x in (zeros, few, np.full((20, 2), np.nan)):
        estimate = fmtorch.find_fundamental(x, x)
        assert not bool(estimate.ok)
        assert estimate.reason[0]
