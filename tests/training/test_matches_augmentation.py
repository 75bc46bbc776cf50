"""Augmentation: the truth stays true, the same draw gives the same matches, ranges are kept."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from fmtorch.geometry.epipolar import symmetric_max
from fmtorch.training import Augmentation, LabelledMatches
from fmtorch.training.augmentation import MIN_INLIERS, MIN_MATCHES, subset_size, thinned_counts
from tests.training.conftest import exact

NOISELESS = Augmentation(noise=None, matches=None)
ALWAYS = Augmentation(swap=1, quarter_turn=0.5, turn=0.5, angle=180, crop=1, thin=1, noise=(1, 2), matches=(50, 60))


def same(a: LabelledMatches, b: LabelledMatches) -> bool:
    fields = [f.name for f in dataclasses.fields(a.correspondences) if getattr(a.correspondences, f.name) is not None]
    return (
        torch.equal(a.F, b.F)
        and torch.equal(a.label, b.label)
        and all(torch.equal(getattr(a.correspondences, n), getattr(b.correspondences, n)) for n in fields)
    )


@pytest.mark.parametrize("epoch", range(30))
def test_the_truth_stays_true(epoch: int) -> None:
    before = exact(n=400)
    after = dataclasses.replace(NOISELESS, turn=0.4, quarter_turn=0.4, crop=0.7)(before, seed=0, epoch=epoch)
    c = after.correspondences
    assert symmetric_max(after.F, c.x0, c.x1)[after.label != 0].max() < 1e-8
    singular = torch.linalg.svdvals(c.K1.mT @ after.F @ c.K0)[0]
    assert singular[0] == pytest.approx(float(singular[1]), rel=1e-9)
    assert singular[2] < 1e-9 * singular[0]
    assert torch.equal(c.lafs0[..., 2], c.x0)
    assert torch.equal(c.lafs1[..., 2], c.x1)
    assert c.mask.all()
    # Every match is one of before, with its label: the quality says which.
    old = {float(q): int(v) for q, v in zip(before.correspondences.quality[0], before.label[0], strict=True)}
    assert [old[float(q)] for q in c.quality[0]] == after.label[0].tolist()


def test_the_same_draw_gives_the_same_matches_and_another_one_others() -> None:
    m = exact()
    augmented = ALWAYS(m, seed=3, epoch=5)
    assert same(augmented, ALWAYS(exact(), seed=3, epoch=5))
    assert not same(augmented, ALWAYS(m, seed=3, epoch=6))
    assert not same(augmented, ALWAYS(m, seed=4, epoch=5))
    other = m.replace(correspondences=m.correspondences.replace(key=m.correspondences.keys + 1))
    assert not same(augmented, ALWAYS(other, seed=3, epoch=5))


def test_every_change_happens_and_none_of_them_when_off() -> None:
    m = exact(n=300)
    untouched = Augmentation.none()(m, seed=0)
    order = untouched.correspondences.quality[0].argsort()
    assert same(untouched.reorder(order[None]), m.reorder(m.correspondences.quality.argsort(-1)))
    assert not torch.equal(untouched.correspondences.x0, m.correspondences.x0)  # a random order
    drawn = [Augmentation()(m, seed=0, epoch=e) for e in range(60)]
    sizes = {tuple(d.correspondences.size0[0].tolist()) for d in drawn}
    assert len(sizes) > 20  # turned, cropped, swapped
    assert len({d.label.shape[1] for d in drawn}) > 20
    shares = [float((d.label == 1).sum() / (d.label >= 0).sum()) for d in drawn]
    assert min(shares) < 0.3
    assert max(shares) > 0.7


def test_ranges_are_kept() -> None:
    m = exact(n=600)
    only = Augmentation.none()
    for epoch in range(20):
        subset = dataclasses.replace(only, matches=(50, 300))(m, seed=0, epoch=epoch)
        assert 50 <= subset.label.shape[1] <= 300
        ratio = dataclasses.replace(only, ratio=(0.8, 0.9))(m, seed=0, epoch=epoch).correspondences.quality
        assert 0.75 < ratio.max() < 0.9
        assert ratio.shape[1] >= (m.correspondences.quality < 0.8).sum()
        thinned = dataclasses.replace(only, thin=1, inlier_share=(0.3, 0.4))(m, seed=0, epoch=epoch)
        share = float((thinned.label == 1).sum() / (thinned.label >= 0).sum())
        assert 0.29 < share < 0.41
        noisy = dataclasses.replace(only, noise=(0.5, 0.5))(m, seed=0, epoch=epoch).correspondences
        still = only(m, seed=0, epoch=epoch).correspondences
        steps = torch.cat([noisy.x0 - still.x0, noisy.x1 - still.x1]).flatten()  # 2400 normal numbers
        assert float(steps.std()) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(2 * len(steps)))
        assert abs(float(steps.mean())) < 4 * 0.5 / np.sqrt(len(steps))
    assert only(m, seed=0, count=70).label.shape[1] == 70
    assert only(m, seed=0, count=7000).label.shape[1] == 600


@pytest.mark.parametrize(
    ("inliers", "outliers", "share", "expected"),
    [
        (500, 500, 0.05, (26, 500)),
        (500, 500, 0.5, (500, 500)),
        (500, 500, 0.95, (500, 26)),
        (10, 1000, 0.5, (10, MIN_MATCHES - 10)),  # not fewer than 50 matches are left
        (1000, 10, 0.05, (MIN_INLIERS, 10)),  # nor fewer than 16 inliers
        (5, 10, 0.05, (5, 10)),
        (5, 10, 0.0, (5, 10)),
        (10, 5, 1.0, (10, 5)),
    ],
)
def test_thinning_reaches_its_share(inliers: int, outliers: int, share: float, expected: tuple[int, int]) -> None:
    assert thinned_counts(inliers, outliers, share) == expected


def test_no_pair_loses_its_inliers_to_a_crop() -> None:
    m = exact(n=40, share=0.5)
    hard = dataclasses.replace(Augmentation.none(), crop=1, crop_side=(0.05, 0.1), ratio=(0.01, 0.02))
    for epoch in range(20):
        assert int(hard(m, seed=0, epoch=epoch).inlier.sum()) >= min(MIN_INLIERS, int(m.inlier.sum()))
    none_right = exact(n=40, share=0.0)
    none_right = none_right.replace(label=torch.zeros_like(none_right.label))
    for epoch in range(20):
        assert Augmentation()(none_right, seed=0, epoch=epoch).label.shape[1] > 0


def test_the_subset_size_is_uniform_in_its_logarithm() -> None:
    sizes = np.array([subset_size((50, 4000), u) for u in np.linspace(0, 1, 10000, endpoint=False)])
    assert (subset_size((50, 4000), 0.0), subset_size((50, 4000), 1 - 2.0**-53)) == (50, 4000)
    assert subset_size((7, 7), 0.5) == 7
    assert np.median(sizes) == pytest.approx(np.sqrt(50 * 4001), rel=0.01)


def test_the_expected_length_is_the_length_but_for_crops() -> None:
    m = exact(n=500)
    for epoch in range(20):
        for crop in (0.0, 1.0):
            a = dataclasses.replace(Augmentation(), crop=crop, matches=None)
            length = a(m, seed=1, epoch=epoch).label.shape[1]
            key = int(m.correspondences.keys[0])
            expected = a.expected(m.correspondences.quality[0], m.label[0], key=key, seed=1, epoch=epoch)
            assert expected == pytest.approx(length, abs=1 if crop == 0 else 500)


def test_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="swap is 2"):
        Augmentation(swap=2)
    with pytest.raises(ValueError, match="exclude each other"):
        Augmentation(turn=0.6, quarter_turn=0.6)
    with pytest.raises(ValueError, match="ratio is"):
        Augmentation(ratio=(1.0, 0.8))
    with pytest.raises(ValueError, match="batch of 2"):
        Augmentation()(exact(pairs=2), seed=0)
