"""Two estimators in a row: the second sees the first one's inliers, and each is answerable for its own failures."""

import pytest
import torch

from fmtorch import presets
from fmtorch.core import Correspondences, Estimate, collate
from fmtorch.estimators import CoarseToFine, Ransac
from tests.laws import scene

COARSE = Ransac(hypotheses=200, threshold=2.0)
FINE = Ransac(hypotheses=100, solver="eight_point", score="median", confidence=None, inliers="lmeds")


def test_equals_the_two_by_hand() -> None:
    c = collate([scene(i, n) for i, n in enumerate((150, 90, 200))])
    coarse = COARSE(c, 3)
    fine = FINE(c.keep(coarse.inliers), 3)
    both = CoarseToFine(coarse=COARSE, fine=FINE)(c, 3)
    assert bool(both.ok.all())
    assert torch.equal(both.F, fine.F)
    assert torch.equal(both.inliers, fine.inliers)
    assert bool((both.inliers <= coarse.inliers).all())
    assert torch.equal(both.samples, coarse.samples + fine.samples)


def test_each_stage_names_its_own_failure() -> None:
    class Few:
        """Keeps the first five matches."""

        def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
            estimate = COARSE(c, seed)
            return estimate.replace(inliers=estimate.inliers & (estimate.inliers.cumsum(1) <= 5))

    pairs = collate([scene(0), scene(1).replace(mask=torch.zeros(1, 150, dtype=torch.bool))])
    estimate = CoarseToFine(coarse=Few(), fine=FINE)(pairs)
    assert estimate.reason == ("fine: 5 matches; at least 8 are needed", "coarse: 0 matches; at least 7 are needed")
    assert not bool(estimate.ok.any())
    assert not bool(estimate.inliers.any())
    assert not bool(estimate.F.any())


def test_a_stage_s_options_are_replaced_by_name() -> None:
    estimator = presets.build("estimator", "cf_ransac", fine={"hypotheses": 77}, coarse={"threshold": 3.5})
    assert estimator.fine.search.hypotheses == 77
    assert estimator.fine.search.round == presets.build("estimator", "lmeds").search.round
    assert estimator.coarse.inlier_rule.threshold == 3.5
    with pytest.raises(ValueError, match=r"estimator=cf_ransac\.fine: no option treshold; there are: "):
        presets.build("estimator", "cf_ransac", fine={"treshold": 1.0})
