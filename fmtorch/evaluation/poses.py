"""The pose error of each pair of known cameras, and why a pair has none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.data.pairs import ImagePair
from fmtorch.evaluation.outcomes import joined_correspondences, joined_estimates
from fmtorch.metrics import fundamental_pose_error
from fmtorch.pipeline.pipeline import Outcome

LARGEST_ROTATION, LARGEST_TRANSLATION = 180.0, 90.0  # degrees: what a failed pair counts as


class PairPose(NamedTuple):
    """Angles in degrees; None where the true pose is unknown. reason: why there is no error, or no pose."""

    rotation: float | None
    translation: float | None
    reason: str | None


def pose_errors(outcomes: Sequence[Outcome]) -> list[PairPose]:
    """The pose error of each pair by its F, K0, K1 and the estimator's inliers, see `fundamental_pose_error`.

    A pair without F, or whose F has no pose, has the largest errors and a reason; one whose calibration or motion is
    unknown has a reason only.
    """
    poses = [_without_estimate(outcome) for outcome in outcomes]
    known = [i for i, o in enumerate(outcomes) if poses[i].reason is None]
    if known:
        estimated = [outcomes[i] for i in known]
        c, estimate = joined_correspondences(estimated), joined_estimates(estimated)
        K0, K1, R, t = (
            _stacked([getattr(o.pair, name) for o in estimated]) for name in ("K0", "K1", "R", "t")
        )  # fmt: skip
        error = fundamental_pose_error(estimate.F.double(), K0, K1, c.x0, c.x1, R, t, estimate.inliers & c.mask)
        for i, rotation, translation in zip(known, error.rotation.tolist(), error.translation.tolist(), strict=True):
            none = rotation >= LARGEST_ROTATION
            poses[i] = PairPose(rotation, translation, "no inlier in front of both cameras" if none else None)
    return poses


def _without_estimate(outcome: Outcome) -> PairPose:
    """What is known before F is looked at."""
    missing = unknown(outcome.pair)
    if missing is not None:
        return PairPose(None, None, missing)
    if not outcome.solved:
        return PairPose(LARGEST_ROTATION, LARGEST_TRANSLATION, "no F")
    return PairPose(None, None, None)


def unknown(pair: ImagePair) -> str | None:
    """Why the true pose of a pair is not known; None where it is."""
    values = {"K0": pair.K0, "K1": pair.K1, "R": pair.R, "t": pair.t}
    missing = [name for name, value in values.items() if value is None]
    if missing:
        return f"{', '.join(missing)} unknown"
    broken = [name for name, value in values.items() if not np.isfinite(cast(NDArray[np.float64], value)).all()]
    return f"{', '.join(broken)} not finite" if broken else None


def _stacked(values: Sequence[NDArray[np.float64] | None]) -> Tensor:
    return torch.stack([torch.from_numpy(np.asarray(value, np.float64)) for value in values])
