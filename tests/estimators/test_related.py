"""Whether two images show one scene: every estimator says so, of all the matches that it was given."""

import functools

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch.core import Correspondences, Estimate, Estimator, collate
from fmtorch.geometry import significance
from fmtorch.geometry.significance import judged
from tests.laws import quick, scene
from tests.variants import variants

ESTIMATORS = [n for n in variants("estimator") if "_cpp" not in n and n != "homography"]
NOT_ROBUST = ("irls:loss=huber", "irls:loss=cauchy")  # against three wrong matches in ten


@functools.cache
def chance() -> Correspondences:
    """Pairs that show nothing in common: as many matches as unrelated photographs have, with ratios of wrong ones."""
    pairs = [scene(i, count, outliers=1.0) for i, count in enumerate((8, 9, 10, 12, 16, 20, 30, 40, 60, 90) * 2)]
    return collate(pairs)


@functools.cache
def common() -> Correspondences:
    return collate([scene(i, 150, outliers=0.3) for i in range(6)])


def estimator(name: str) -> Estimator:
    try:
        return quick(name, 400, 200)
    except ImportError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_tells_scenes_from_chance(name: str) -> None:
    c, chances = collate([chance(), common()]), len(chance())
    estimate = estimator(name)(c, seed=1)
    expected = significance(estimate.F, c.x0, c.x1, c.mask, c.size0, c.size1)
    assert torch.equal(estimate.significance, torch.where(estimate.ok, expected, -torch.inf))
    assert not bool(estimate.related[:chances].any()), estimate.significance[:chances].max()
    if name not in NOT_ROBUST:
        assert int(estimate.related[chances:].sum()) >= len(common()) - 1, estimate.significance[chances:]


def test_coarse_to_fine_is_judged_by_all_matches() -> None:
    """The inliers of a first estimator agree by selection, and are no evidence for the second one."""
    c = chance()
    coarse = quick("ransac", 400, 200)
    fine = quick("lmeds", 200, 100)
    kept = c.keep(coarse(c).inliers)
    assert float(fine(kept).significance.max()) > float(quick("cf_ransac", 400, 200)(c).significance.max())


def silent(c: Correspondences, seed: int = 0) -> Estimate:
    """An estimator of a user's own, which knows nothing of significance."""
    known = quick("ransac", 200, 100)(c, seed)
    return Estimate(known.F, known.inliers, known.ok, known.reason, known.samples)


def test_what_an_estimator_does_not_say_is_said_by_the_caller() -> None:
    c = common()
    without = silent(c)
    assert bool(without.significance.isnan().all())
    assert not bool(without.related.any())
    with_significance = judged(without, c)
    assert torch.equal(with_significance.significance, quick("ransac", 200, 100)(c).significance)
    assert bool(with_significance.related.all())
    own = without.replace(significance=torch.full((len(c),), 7.0, dtype=torch.float64))
    assert judged(own, c) is own


def test_find_fundamental_tells() -> None:
    c = collate([scene(1, 100, 0.3), scene(2, 40, 1.0)])
    estimate = fmtorch.find_fundamental(c.x0, c.x1, mask=c.mask, ratio=c.ratio, size0=(640, 960), size1=(640, 960))
    assert estimate.ok[0]
    assert estimate.related.tolist() == [True, False]
    assert estimate[1:].significance.tolist() == estimate.significance[1:].tolist()
    rng = np.random.default_rng(0)
    assert not bool(fmtorch.find_fundamental(*rng.uniform(0, 500, (2, 20, 2)), estimator="ransac").related[0])
