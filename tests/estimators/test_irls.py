"""The M-estimators reach the optimum, and use what is known of the matches."""

import pytest
import torch

from fmtorch.core import collate
from fmtorch.estimators import IterativelyReweighted
from fmtorch.geometry import LOSSES, refine
from tests.laws import scene
from tests.reference import refine as reference


@pytest.mark.parametrize("loss", LOSSES)
def test_is_a_minimum_of_the_weighted_loss(loss: str) -> None:
    c = collate([scene(i, 150, outliers=0.05) for i in range(3)])
    estimate = IterativelyReweighted(loss=loss, threshold=2.0, refine_iterations=60)(c)
    assert bool(estimate.ok.all())
    assert bool((estimate.samples == 0).all())
    prior = c.prior

    def cost(F: torch.Tensor, i: int) -> float:
        r2 = reference.sampson(F.numpy(), c.x0[i].double().numpy(), c.x1[i].double().numpy()) ** 2
        return float((prior[i].double().numpy() * reference.loss(r2, 4.0, loss)).sum())

    further = refine(estimate.F, c.x0, c.x1, prior, c.mask, loss=loss, scale=2.0, iterations=50)
    for i in range(3):
        assert cost(estimate.F[i], i) <= cost(further[i], i) * (1 + 1e-9)


def test_an_annealed_loss_is_not_caught_where_a_narrow_one_is() -> None:
    pairs = collate([scene(i, 150, outliers=0.3) for i in range(40)]).replace(prior=None, ratio=None)
    near = []
    for options in ({}, {"start_scale": 1e-9}):
        estimate = IterativelyReweighted(loss="truncated", threshold=1.0, **options)(pairs)
        near.append(estimate.inliers.sum(1).to(torch.float64).mean())
    assert near[0] > 1.3 * near[1]


def test_the_prior_and_the_quality_decide_where_there_are_more_outliers_than_inliers() -> None:
    pairs = collate([scene(i, 150, outliers=0.65) for i in range(16)])
    inliers = {
        name: int(IterativelyReweighted(loss="geman_mcclure", threshold=1.0)(c).inliers.sum())
        for name, c in {
            "prior": pairs,
            "ratio": pairs.replace(prior=None),
            "nothing": pairs.replace(prior=None, ratio=None),
        }.items()
    }
    assert inliers["prior"] > 1.2 * inliers["nothing"]
    assert inliers["ratio"] > 1.2 * inliers["nothing"]


@pytest.mark.parametrize(
    ("options", "message"),
    [({"loss": "tukey"}, "loss is 'tukey'"), ({"threshold": 0.0}, "must be positive"),
     ({"starts": []}, "list of integers"), ({"starts": [1, -1]}, "list of integers")],
)  # fmt: skip
def test_bad_options_are_told(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        IterativelyReweighted(**{"loss": "huber", "threshold": 1.0, **options})  # type: ignore[arg-type]
