"""The pose error of each pair of known cameras, and why a pair has none."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.data.pairs import ImagePair
from fmtorch.evaluation.outcomes import joined_correspondences, joined_estimates
from fmtorch.metrics import closest_pose_error, fundamental_pose_error, pose_error
from fmtorch.metrics.pose import PoseError
from fmtorch.pipeline.pipeline import Outcome

LARGEST_ROTATION, LARGEST_TRANSLATION = 180.0, 90.0  # degrees: what a failed pair counts as, 180 with the sign of t


class PairPose(NamedTuple):
    """Angles in degrees; None where the true pose is unknown. reason: why there is no error, or no pose."""

    rotation: float | None
    translation: float | None
    reason: str | None


def pose_errors(outcomes: Sequence[Outcome], signed: bool = False) -> list[PairPose]:
    """The pose error of each pair: of the estimate's R and t, or else of its F, K0, K1 and the estimator's inliers.

    See `pose_error` and `fundamental_pose_error`. A pair without F, or without a pose, has the largest errors and a
    reason; one whose calibration or motion is unknown has a reason only.

    signed: the sign of the translation counts, and of the four poses of F the best one: `closest_pose_error`.
    """
    poses = [_without_estimate(outcome, signed) for outcome in outcomes]
    known = [i for i, o in enumerate(outcomes) if poses[i].reason is None]
    for estimated, error_of, reason in (
        (True, functools.partial(_of_pose, up_to_sign=not signed), "the pose is not determined"),
        (False, _closest, "F has no pose") if signed else
        (False, _of_fundamental, "no inlier in front of both cameras"),
    ):  # fmt: skip
        own = [i for i in known if _has_pose(outcomes[i]) == estimated]
        error = error_of([outcomes[i] for i in own]) if own else PoseError(torch.zeros(0), torch.zeros(0))
        for i, rotation, translation in zip(own, error.rotation.tolist(), error.translation.tolist(), strict=True):
            poses[i] = PairPose(rotation, translation, reason if rotation >= LARGEST_ROTATION else None)
    return poses


def _has_pose(outcome: Outcome) -> bool:
    """Whether the estimator gives a pose, which may not be determined."""
    return outcome.estimate is not None and outcome.estimate.R is not None


def _of_pose(outcomes: Sequence[Outcome], up_to_sign: bool) -> PoseError:
    estimate, (R, t) = joined_estimates(outcomes), _truth(outcomes, "R", "t")
    own = cast(Tensor, estimate.R).double(), cast(Tensor, estimate.t).double()
    return pose_error(*own, R, t, up_to_sign=up_to_sign)


def _of_fundamental(outcomes: Sequence[Outcome]) -> PoseError:
    c, estimate = joined_correspondences(outcomes), joined_estimates(outcomes)
    K0, K1, R, t = _truth(outcomes, "K0", "K1", "R", "t")
    return fundamental_pose_error(estimate.F.double(), K0, K1, c.x0, c.x1, R, t, estimate.inliers & c.mask)


def _closest(outcomes: Sequence[Outcome]) -> PoseError:
    return closest_pose_error(joined_estimates(outcomes).F.double(), *_truth(outcomes, "K0", "K1", "R", "t"))


def _without_estimate(outcome: Outcome, signed: bool) -> PairPose:
    """What is known before F is looked at."""
    missing = unknown(outcome.pair)
    if missing is not None:
        return PairPose(None, None, missing)
    if not outcome.solved:
        return PairPose(LARGEST_ROTATION, LARGEST_ROTATION if signed else LARGEST_TRANSLATION, "no F")
    return PairPose(None, None, None)


def unknown(pair: ImagePair) -> str | None:
    """Why the true pose of a pair is not known; None where it is."""
    values = {"K0": pair.K0, "K1": pair.K1, "R": pair.R, "t": pair.t}
    missing = [name for name, value in values.items() if value is None]
    if missing:
        return f"{', '.join(missing)} unknown"
    broken = [name for name, value in values.items() if not np.isfinite(cast(NDArray[np.float64], value)).all()]
    return f"{', '.join(broken)} not finite" if broken else None


def _truth(outcomes: Sequence[Outcome], *names: str) -> list[Tensor]:
    """What is true of each pair, by its names in `ImagePair`, float64."""
    values = ([np.asarray(getattr(o.pair, name), np.float64) for o in outcomes] for name in names)
    return [torch.from_numpy(np.stack(each)) for each in values]
