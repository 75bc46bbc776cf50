"""Changes of labelled matches: the truth stays true, the same draw gives the same matches, ranges are kept."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fmtorch.geometry import symmetric_max
from fmtorch.training import Augmentation, LabelledMatches
from fmtorch.training.augmentation import crop, keep_ratio, move, rotate, swap
from tests.training.conftest import exact

CHANGES: dict[str, Callable[[LabelledMatches], LabelledMatches]] = {
    "swap": swap,
    "quarter turn": lambda m: rotate(m, 0, 90),
    "three quarters": lambda m: rotate(m, 1, -90),
    "turn": lambda m: rotate(m, 0, 33.3),
    "crop": lambda m: crop(m, 0, (100, 37, 640, 400)),
    "ratio": lambda m: keep_ratio(m, 0.8),
    "all": lambda m: swap(rotate(crop(rotate(m, 0, 50), 0, (80, 80, 600, 500)), 1, 90)),
}
NOISELESS = Augmentation(noise=None, matches=None)
ALWAYS = Augmentation(swap=1, quarter_turn=0.5, turn=0.5, angle=180, crop=1, thin=1, noise=(1, 2), matches=(50, 60))
ONLY = Augmentation.none()


def same(a: LabelledMatches, b: LabelledMatches) -> bool:
    fields = [f.name for f in dataclasses.fields(a.correspondences) if getattr(a.correspondences, f.name) is not None]
    return (
        torch.equal(a.F, b.F)
        and torch.equal(a.label, b.label)
        and all(torch.equal(getattr(a.correspondences, n), getattr(b.correspondences, n)) for n in fields)
    )


def expect_truth(m: LabelledMatches) -> None:
    """F, calibrations, frames and labels fit each other."""
    c = m.correspondences
    true = (m.label != 0) & c.mask
    # Coordinates below 1000 px in float64: distances of some ulps times the conditioning of the lines.
    assert symmetric_max(m.F, c.x0, c.x1)[true].max() < 1e-8
    torch.testing.assert_close(torch.linalg.matrix_norm(m.F), torch.ones(len(m)).double())
    singular = torch.linalg.svdvals(c.K1.mT @ m.F @ c.K0)
    torch.testing.assert_close(singular[:, 0], singular[:, 1], rtol=1e-9, atol=0)
    assert (singular[:, 2] < 1e-9 * singular[:, 0]).all()
    for x, lafs, K in ((c.x0, c.lafs0, c.K0), (c.x1, c.lafs1, c.K1)):
        assert torch.equal(lafs[..., 2], x)
        assert (K.tril(-1) == 0).all()
        assert (K.diagonal(dim1=-2, dim2=-1) > 0).all()
        torch.testing.assert_close(K[:, 2, 2], torch.ones(len(m)).double())


@pytest.mark.parametrize("name", CHANGES)
def test_the_truth_stays_true_after_each_change(name: str) -> None:
    before = exact(pairs=2)
    after = CHANGES[name](before)
    expect_truth(after)
    c, old = after.correspondences, before.correspondences
    assert ((after.label != 0) & c.mask).sum() > 20
    assert torch.equal(after.label[c.mask], before.label[c.mask])
    assert torch.equal(c.ratio, old.ratio)
    assert torch.equal(c.keys, old.keys)
    if name not in ("swap", "all"):  # points lie in their images
        for x, size, x_old, size_old in ((c.x0, c.size0, old.x0, old.size0), (c.x1, c.size1, old.x1, old.size1)):
            limit, old_limit = size.flip(-1)[:, None] - 0.5, size_old.flip(-1)[:, None] - 0.5
            was_inside = ((x_old >= -0.5) & (x_old < old_limit)).all(-1) & c.mask
            assert ((x >= -0.5) & (x <= limit)).all(-1)[was_inside].all()


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
    with pytest.raises(ValueError, match="size0"):
        rotate(before.replace(correspondences=c.replace(size0=None)), 0, 90)


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


def test_ratio_noise_and_two_swaps() -> None:
    m = exact()
    c = m.correspondences
    assert torch.equal(keep_ratio(m, 0.6).correspondences.mask, c.ratio < 0.6)
    at_one = m.replace(correspondences=c.replace(ratio=torch.ones_like(c.ratio)))
    assert keep_ratio(at_one, 1.0).correspondences.mask.all()
    with pytest.raises(ValueError, match="ratio"):
        keep_ratio(m.replace(correspondences=c.replace(ratio=None)), 0.8)
    step0, step1 = torch.full_like(c.x0, 0.5), torch.full_like(c.x1, -2.0)
    moved = move(m, step0, step1).correspondences
    torch.testing.assert_close(moved.x0 - c.x0, step0)
    torch.testing.assert_close(moved.lafs1[..., 2] - c.lafs1[..., 2], step1)
    assert torch.equal(moved.lafs1[..., :2], c.lafs1[..., :2])
    assert same(swap(swap(m)), m)


@pytest.mark.parametrize("epoch", range(4))
def test_the_truth_stays_true_after_any_draw(epoch: int) -> None:
    before = exact(n=400)
    after = dataclasses.replace(NOISELESS, turn=0.4, quarter_turn=0.4, crop=0.7)(before, seed=0, epoch=epoch)
    expect_truth(after)
    assert after.correspondences.mask.all()
    # Every match is one of before, with its label: the ratio says which.
    old = {float(q): int(v) for q, v in zip(before.correspondences.ratio[0], before.label[0], strict=True)}
    assert [old[float(q)] for q in after.correspondences.ratio[0]] == after.label[0].tolist()


def test_the_same_draw_gives_the_same_matches_and_another_one_others() -> None:
    m = exact()
    augmented = ALWAYS(m, seed=3, epoch=5)
    assert same(augmented, ALWAYS(exact(), seed=3, epoch=5))
    assert not same(augmented, ALWAYS(m, seed=3, epoch=6))
    assert not same(augmented, ALWAYS(m, seed=4, epoch=5))
    other = m.replace(correspondences=m.correspondences.replace(key=m.correspondences.keys + 1))
    assert not same(augmented, ALWAYS(other, seed=3, epoch=5))


def test_ranges_are_kept() -> None:
    m = exact(n=600)
    for epoch in range(10):
        subset = dataclasses.replace(ONLY, matches=(50, 300))(m, seed=0, epoch=epoch)
        assert 50 <= subset.label.shape[1] <= 300
        ratio = dataclasses.replace(ONLY, ratio=(0.8, 0.9))(m, seed=0, epoch=epoch).correspondences.ratio
        assert 0.75 < ratio.max() < 0.9
        assert ratio.shape[1] >= (m.correspondences.ratio < 0.8).sum()
        thinned = dataclasses.replace(ONLY, thin=1, inlier_share=(0.3, 0.4))(m, seed=0, epoch=epoch)
        assert 0.29 < float((thinned.label == 1).sum() / (thinned.label >= 0).sum()) < 0.41
        noisy = dataclasses.replace(ONLY, noise=(0.5, 0.5))(m, seed=0, epoch=epoch).correspondences
        still = ONLY(m, seed=0, epoch=epoch).correspondences
        steps = torch.cat([noisy.x0 - still.x0, noisy.x1 - still.x1]).flatten()  # 2400 normal numbers
        assert float(steps.std()) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(2 * len(steps)))
        assert abs(float(steps.mean())) < 4 * 0.5 / np.sqrt(len(steps))
    assert ONLY(m, seed=0, count=70).label.shape[1] == 70
    assert ONLY(m, seed=0, count=7000).label.shape[1] == 600


def test_mistakes_are_named() -> None:
    for options, message in (
        ({"swap": 2}, "swap is 2"),
        ({"turn": 0.6, "quarter_turn": 0.6}, "exclude each other"),
        ({"ratio": (1.0, 0.8)}, "ratio is"),
    ):
        with pytest.raises(ValueError, match=message):
            Augmentation(**options)
    with pytest.raises(ValueError, match="batch of 2"):
        Augmentation()(exact(pairs=2), seed=0)
