"""What a pipeline made of one pair, and of several as one batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch

from fmtorch.core.stages import PairImages
from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.data.pairs import ImagePair
from fmtorch.two_view.pair_type import Configuration


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """What a pipeline made of one pair.

    correspondences, estimate: batches of one; None where the pair failed before that stage.
    features: how many each image has. seconds: per stage; a batched stage is shared out evenly, and features count in
    full for each pair that uses them, cached ones with the seconds they took when they were computed.
    reason: why the pair failed, empty where it did not. configuration, not_examined: of this pair alone, or why there
    is none, where it was asked for (`fmtorch.pipeline.examination`). images: for pruners that look at them. keypoints:
    the correspondences as the matcher left them, where pruners that look at images may have moved their points.
    """

    pair: ImagePair
    features: tuple[int, int] = (0, 0)
    correspondences: Correspondences | None = None
    estimate: Estimate | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    reason: str = ""
    configuration: Configuration | None = None
    not_examined: str = ""
    images: PairImages | None = None
    keypoints: Correspondences | None = None

    @property
    def solved(self) -> bool:
        """Whether there is an F."""
        return self.estimate is not None and bool(self.estimate.ok[0])


def expect_finite(estimate: Estimate) -> Estimate:
    """The estimate, whose pairs are not ok where F is no matrix: anybody's estimator may have made it."""
    valid = torch.isfinite(estimate.F).flatten(1).all(1) & (estimate.F != 0).flatten(1).any(1)
    wrong = (estimate.ok & ~valid).tolist()
    if not any(wrong):
        return estimate
    said = "estimation: F is zero or not finite, though the estimator calls it ok"
    reason = tuple(said if bad else old for bad, old in zip(wrong, estimate.reason, strict=True))
    keep = valid[:, None]
    F, inliers = torch.where(keep[..., None], estimate.F, 0), estimate.inliers & keep
    return estimate.replace(F=F, inliers=inliers, ok=estimate.ok & valid, reason=reason, significance=None)


def collated(outcomes: Sequence[Outcome]) -> Correspondences:
    """The matches of the outcomes that have some, as one batch."""
    return collate([outcome.correspondences for outcome in outcomes if outcome.correspondences is not None])


def described(stage: str, error: Exception) -> str:
    """What a stage raised, as a reason of one line."""
    return f"{stage}: {type(error).__name__}: {error}".splitlines()[0]
