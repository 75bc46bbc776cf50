"""After every change of the images the truth is still true: F, calibration, frames, sizes and labels fit each other."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fmtorch.geometry.epipolar import symmetric_max
from fmtorch.training import LabelledMatches
from fmtorch.training.augmentation import crop, keep_ratio, move, rotate, swap, transform
from tests.training.conftest import exact

CHANGES: dict[str, Callable[[LabelledMatches], LabelledMatches]] = {
    "swap": swap,
    "quarter turn": lambda m: rotate(m, 0, 90),
    "half turn": lambda m: rotate(m, 1, 180),
    "three quarters": lambda m: rotate(m, 1, -90),
    "turn": lambda m: rotate(m, 0, 33.3),
    "turn back": lambda m: rotate(m, 1, -128.0),
    "crop": lambda m: crop(m, 0, (100, 37, 640, 400)),
    "crop 1": lambda m: crop(m, 1, (0, 20, 300, 300)),
    "ratio": lambda m: keep_ratio(m, 0.8),
    "all": lambda m: swap(rotate(crop(rotate(m, 0, 50), 0, (80, 80, 600, 500)), 1, 90)),
}


def essential(m: LabelledMatches) -> torch.Tensor:
    c = m.correspondences
    return c.K1.mT @ m.F @ c.K0


@pytest.mark.parametrize("name", CHANGES)
def test_the_truth_stays_true(name: str) -> None:
    before = exact(pairs=2)
    after = CHANGES[name](before)
    c = after.correspondences
    true = (after.label != 0) & c.mask
    assert true.sum() > 20
    # Coordinates below 1000 px in float64: distances of some ulps times the conditioning of the lines.
    assert symmetric_max(after.F, c.x0, c.x1)[true].max() < 1e-8
    torch.testing.assert_close(torch.linalg.matrix_norm(after.F), torch.ones(2).double())
    assert torch.equal(after.label[c.mask], before.label[c.mask])
    assert torch.equal(c.quality, before.correspondences.quality)
    assert torch.equal(c.keys, before.correspondences.keys)
    singular = torch.linalg.svdvals(essential(after))
    torch.testing.assert_close(singular[:, 0], singular[:, 1], rtol=1e-9, atol=0)
    assert (singular[:, 2] < 1e-9 * singular[:, 0]).all()
    for K in (c.K0, c.K1):
        assert (K.tril(-1) == 0).all()
        assert (K.diagonal(dim1=-2, dim2=-1) > 0).all()
        torch.testing.assert_close(K[:, 2, 2], torch.ones(2).double())


@pytest.mark.parametrize("name", CHANGES)
def test_frames_go_with_their_points_and_points_lie_in_their_images(name: str) -> None:
    after = CHANGES[name](exact(pairs=2)).correspondences
    for x, lafs in ((after.x0, after.lafs0), (after.x1, after.lafs1)):
        assert torch.equal(lafs[..., 2], x)
    before = exact(pairs=2).correspondences
    for i, (x, size, old, old_size) in enumerate(
        ((after.x0, after.size0, before.x0, before.size0), (after.x1, after.size1, before.x1, before.size1))
    ):
        limit, old_limit = size.flip(-1)[:, None] - 0.5, old_size.flip(-1)[:, None] - 0.5
        was_inside = ((old >= -0.5) & (old < old_limit)).all(-1) & after.mask
        if name not in ("swap", "all"):
            assert ((x >= -0.5) & (x <= limit)).all(-1)[was_inside].all(), i


@settings(deadline=None, max_examples=40)
@given(degrees=st.floats(-720, 720), image=st.integers(0, 1))
def test_any_turn(degrees: float, image: int) -> None:
    before = exact(3, n=30)
    after = rotate(before, image, degrees)
    c, old = after.correspondences, before.correspondences
    assert symmetric_max(after.F, c.x0, c.x1)[after.label != 0].max() < 1e-8
    x, lafs, size, x_old, lafs_old, size_old = (
        (c.x1, c.lafs1, c.size1, old.x1, old.lafs1, old.size1) if image else
        (c.x0, c.lafs0, c.size0, old.x0, old.lafs0, old.size0)
    )  # fmt: skip
    # A rigid motion that keeps the orientation: distances between points, and determinants and lengths of frames.
    torch.testing.assert_close(torch.cdist(x, x), torch.cdist(x_old, x_old), atol=1e-4, rtol=1e-7)
    torch.testing.assert_close(torch.linalg.det(lafs[..., :2]), torch.linalg.det(lafs_old[..., :2]))
    assert (size >= size_old.min()).all()
    assert torch.hypot(*size[0].double()) <= 2**0.5 * torch.hypot(*size_old[0].double()) + 2


def test_a_quarter_turn_is_exact_and_four_of_them_are_none() -> None:
    before = exact()
    c = before.correspondences
    once = rotate(before, 0, 90).correspondences
    h = c.size0[0, 0]
    assert once.size0.tolist() == [c.size0[0].flip(0).tolist()]
    assert torch.equal(once.x0, torch.stack([h - 1 - c.x0[..., 1], c.x0[..., 0]], -1))  # clockwise as one looks at it
    again = before
    for _ in range(4):
        again = rotate(again, 0, 90)
    torch.testing.assert_close(again.correspondences.x0, c.x0, rtol=0, atol=1e-12)
    torch.testing.assert_close(again.correspondences.K0, c.K0, rtol=1e-14, atol=1e-12)
    torch.testing.assert_close(again.F, before.F, rtol=0, atol=1e-14)
    assert torch.equal(again.correspondences.size0, c.size0)


def test_frames_are_mapped_as_the_points_around_them() -> None:
    before = exact()
    T = torch.tensor([[[0.8, -0.5, 20.0], [0.6, 1.1, -7.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    after = transform(before, 1, T).correspondences
    corner = torch.tensor([0.3, -1.7, 1.0]).double()
    expected = before.correspondences.lafs1 @ corner @ T[0, :2, :2].T + T[0, :2, 2]
    torch.testing.assert_close(after.lafs1 @ corner, expected)


def test_a_crop_masks_what_is_outside_and_moves_the_principal_point() -> None:
    before = exact()
    c = before.correspondences
    after = crop(before, 0, (100, 50, 400, 250)).correspondences
    inside = ((c.x0 >= torch.tensor([99.5, 49.5])) & (c.x0 < torch.tensor([399.5, 249.5]))).all(-1)
    assert torch.equal(after.mask, inside)
    assert 0 < inside.sum() < inside.numel()
    assert after.size0.tolist() == [[200, 300]]
    torch.testing.assert_close(after.K0[:, :2, 2], c.K0[:, :2, 2] - torch.tensor([100.0, 50.0]))
    assert torch.equal(after.x1, c.x1)
    with pytest.raises(ValueError, match="empty"):
        crop(before, 0, (10, 10, 10, 20))


def test_ratio_and_noise() -> None:
    m = exact()
    c = m.correspondences
    assert torch.equal(keep_ratio(m, 0.6).correspondences.mask, c.quality < 0.6)
    at_one = m.replace(correspondences=c.replace(quality=torch.ones_like(c.quality)))
    assert keep_ratio(at_one, 1.0).correspondences.mask.all()
    with pytest.raises(ValueError, match="quality"):
        keep_ratio(m.replace(correspondences=c.replace(quality=None)), 0.8)
    step0, step1 = torch.full_like(c.x0, 0.5), torch.full_like(c.x1, -2.0)
    moved = move(m, step0, step1).correspondences
    torch.testing.assert_close(moved.x0 - c.x0, step0)
    torch.testing.assert_close(moved.lafs1[..., 2] - c.lafs1[..., 2], step1)
    assert torch.equal(moved.lafs1[..., :2], c.lafs1[..., :2])
    with pytest.raises(ValueError, match="size0"):
        rotate(m.replace(correspondences=c.replace(size0=None)), 0, 90)


def test_swapping_twice_changes_nothing() -> None:
    m = exact(pairs=2)
    again = swap(swap(m))
    for name in ("x0", "x1", "lafs0", "lafs1", "size0", "size1", "K0", "K1", "quality", "mutual", "mask"):
        assert torch.equal(getattr(again.correspondences, name), getattr(m.correspondences, name))
    assert torch.equal(again.F, m.F)
