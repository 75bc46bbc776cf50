"""Outcomes of several pairs as batches on the CPU: metrics are float64, and so little work needs no GPU."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch import metrics
from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.data.pairs import ImagePair
from fmtorch.metrics import (
    closest_pose_error,
    corner_error,
    fundamental_pose_error,
    pose_auc,
    pose_error,
    right_of_homography,
)
from fmtorch.metrics.pose import PoseError
from fmtorch.pipeline.pipeline import STAGES, Outcome
from fmtorch.runs import PairRow


def joined_correspondences(outcomes: Sequence[Outcome]) -> Correspondences:
    """Those of the outcomes that have some."""
    return collate([o.correspondences.to("cpu") for o in outcomes if o.correspondences is not None])


def joined_estimates(outcomes: Sequence[Outcome]) -> Estimate:
    """Those of the outcomes that have one."""
    return collate([o.estimate.to("cpu") for o in outcomes if o.estimate is not None])


def joined_true(outcomes: Sequence[Outcome]) -> Tensor:
    """The true F, (B, 3, 3) float64."""
    return torch.stack([torch.from_numpy(o.pair.F) for o in outcomes])


# The errors of the focal lengths that a run estimates, of pairs whose calibrations are known


class FocalErrors(NamedTuple):
    """Of both images: ``|f - f_true| / f_true``, and ``log(f / f_true)``.

    None where no focal length was estimated, since it was given exactly or nobody asked, or the true one is not known.
    Where it was to be estimated and is not determined the error is infinite and the ratio None.
    """

    error: tuple[float | None, float | None] = (None, None)
    log_ratio: tuple[float | None, float | None] = (None, None)


def focal_errors(outcome: Outcome) -> FocalErrors:
    """The errors of one pair, by what its estimator was given (`fmtorch.pipeline.pipeline`)."""
    c, estimate = outcome.correspondences, outcome.estimate
    if c is None or c.focal is None or estimate is None:
        return FocalErrors()
    errors: list[float | None] = []
    ratios: list[float | None] = []
    for i, K in enumerate((outcome.pair.K0, outcome.pair.K1)):
        true = _focal(K)
        exact = float(c.focal[0, i, 1]) == 0
        if true is None or exact:
            errors.append(None)
            ratios.append(None)
            continue
        focal = math.nan if estimate.focals is None or not outcome.solved else float(estimate.focals[0, i])
        determined = math.isfinite(focal) and focal > 0
        errors.append(abs(focal - true) / true if determined else math.inf)
        ratios.append(math.log(focal / true) if determined else None)
    return FocalErrors((errors[0], errors[1]), (ratios[0], ratios[1]))


def _focal(K: NDArray[np.float64] | None) -> float | None:
    """The focal length of a calibration, px: the geometric mean of those along x and y."""
    if K is None or not np.isfinite(K).all():
        return None
    product = float(K[0, 0] * K[1, 1]) / float(K[2, 2]) ** 2 if K[2, 2] else 0.0
    return math.sqrt(product) if product > 0 else None


# Pairs of known homographies: their errors and inlier rates, of outcomes whose estimator gives homographies


THRESHOLDS = (1, 3, 5)  # px, as LightGlue (Lindenberger et al., ICCV 2023); SuperGlue and LoFTR: 3, 5, 10
INLIERS = (
    "%Inlier: right matches, within 3 px of the true homography, and #Corrs, after estimation, -m: before; means over "
    "the pairs that did not fail."
)
CAPTION = (
    "By the mean distance, in image 1, between the corners of image 0 as the true and the estimated homography map "
    "them; failures are misses. AUC: area under the recall curve; corner error: median."
)
Values = NDArray[np.float64]


class PlaneFigures(NamedTuple):
    """The corner error in pixels, infinite where the pair failed, and the shares of right matches, NaN if undefined."""

    corner_error: float
    before: float
    after: float


NOTHING = PlaneFigures(math.inf, math.nan, math.nan)


def plane_figures(outcomes: Sequence[Outcome]) -> list[PlaneFigures]:
    """Of each outcome of a pair of a known homography."""
    figures = [NOTHING] * len(outcomes)
    places = [i for i, o in enumerate(outcomes) if o.estimate is not None and o.correspondences is not None]
    if not places:
        return figures
    with_matches = [outcomes[i] for i in places]
    c, estimate = joined_correspondences(with_matches), joined_estimates(with_matches)
    if c.size0 is None:
        raise ValueError("correspondences come without image sizes (size0, size1); the matcher must supply them")
    H = torch.stack([torch.from_numpy(np.asarray(o.pair.H, np.float64)) for o in with_matches])
    errors = torch.where(estimate.ok, corner_error(estimate.F, H, c.size0), torch.inf)
    right = right_of_homography(H, c.x0, c.x1, mask=c.mask)
    kept = estimate.inliers & c.mask
    before = right.sum(-1).double() / c.mask.sum(-1)
    after = torch.where(estimate.ok, (right & kept).sum(-1).double() / kept.sum(-1), torch.nan)
    for i, *values in zip(places, errors.tolist(), before.tolist(), after.tolist(), strict=True):
        figures[i] = PlaneFigures(*values)
    return figures


def homography_figures(errors: Values) -> dict[str, float | int | None] | None:
    """Accuracy of homographies over the pairs whose true one is known; None where there is none.

    errors: corner errors in pixels, (n,), infinite where a pair failed, NaN where no homography is known.

    - pairs: how many are known.
    - auc_1, auc_3, auc_5: area under the recall curve of the corner error to 1, 3, 5 px (`fmtorch.metrics.pose_auc`).
    - corner_error: the median, None where that is infinite.
    """
    known = errors[~np.isnan(errors)]
    if not len(known):
        return None
    areas = pose_auc(torch.from_numpy(known), THRESHOLDS).tolist()
    median = float(np.median(known))
    return {
        "pairs": len(known), **{f"auc_{t}px": area for t, area in zip(THRESHOLDS, areas, strict=True)},
        "corner_error": median if math.isfinite(median) else None,
    }  # fmt: skip


# The pose error of each pair of known cameras, and why a pair has none


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


# Outcomes -> rows: the metrics of a batch of pairs, with stages' seconds and reasons beside them


def evaluate(outcomes: Sequence[Outcome], seed: int = 0, signed: bool = False) -> list[PairRow]:
    """One row a pair. NSGD is 1 where the pipeline failed; an inlier rate is NaN where it is not defined.

    signed: of `pose_errors`.
    """
    planar = [outcome.pair.H is not None for outcome in outcomes]
    if any(planar):
        of_planes = iter(_of_homographies([o for o, own in zip(outcomes, planar, strict=True) if own]))
        others = iter(evaluate([o for o, own in zip(outcomes, planar, strict=True) if not own], seed, signed))
        return [next(of_planes if own else others) for own in planar]
    start = time.perf_counter()
    nsgd, released = _distances(outcomes, seed)
    before, after = _inlier_rates(outcomes)
    poses = pose_errors(outcomes, signed)
    seconds = (time.perf_counter() - start) / max(len(outcomes), 1)
    return [
        _row(outcome, {"nsgd": a, "nsgd_released": b, "inlier_rate_before": c, "inlier_rate": d}, pose, seconds)
        for outcome, a, b, c, d, pose in zip(outcomes, nsgd, released, before, after, poses, strict=True)
    ]


def _of_homographies(outcomes: Sequence[Outcome]) -> list[PairRow]:
    """The rows of pairs of known homographies, which have corner errors in place of NSGD and poses."""
    start = time.perf_counter()
    figures = plane_figures(outcomes)
    seconds = (time.perf_counter() - start) / max(len(outcomes), 1)
    unknown = PairPose(None, None, None)
    rates = ({"nsgd": math.nan, "inlier_rate_before": f.before, "inlier_rate": f.after} for f in figures)
    rows = zip(outcomes, rates, figures, strict=True)
    return [_row(outcome, own, unknown, seconds, f.corner_error) for outcome, own, f in rows]


def _distances(outcomes: Sequence[Outcome], seed: int) -> tuple[list[float], list[float]]:
    """NSGD in both forms."""
    nsgd, released = [1.0] * len(outcomes), [1.0] * len(outcomes)
    known = [i for i, o in enumerate(outcomes) if o.solved]
    if known:
        estimated = [outcomes[i] for i in known]
        c = joined_correspondences(estimated)
        if c.size0 is None or c.size1 is None:
            raise ValueError("correspondences come without image sizes (size0, size1); the matcher must supply them")
        arguments = (joined_true(estimated), joined_estimates(estimated).F, c.size0, c.size1)
        values = metrics.nsgd(*arguments, seed=seed, key=c.keys).tolist()
        values_released = metrics.nsgd_released(*arguments, seed=seed, key=c.keys).tolist()
        for i, a, b in zip(known, values, values_released, strict=True):
            nsgd[i], released[i] = a, b
    return nsgd, released


def _inlier_rates(outcomes: Sequence[Outcome]) -> tuple[list[float], list[float]]:
    """Before and, where the pair was solved, after estimation."""
    before, after = [math.nan] * len(outcomes), [math.nan] * len(outcomes)
    matched = [i for i, o in enumerate(outcomes) if o.estimate is not None and o.correspondences is not None]
    if matched:
        with_matches = [outcomes[i] for i in matched]
        c, estimate = joined_correspondences(with_matches), joined_estimates(with_matches)
        if c.size0 is None or c.size1 is None:
            raise ValueError("correspondences come without image sizes (size0, size1); the matcher must supply them")
        rates = metrics.inlier_rate(
            joined_true(with_matches), c.x0, c.x1, estimate.inliers, c.size0, c.size1, mask=c.mask
        )
        for i, a, b in zip(matched, rates.before.tolist(), rates.after.tolist(), strict=True):
            before[i], after[i] = a, b if outcomes[i].solved else math.nan
    return before, after


def _row(
    outcome: Outcome, figures: dict[str, float], pose: PairPose, seconds: float, corner_error: float | None = None
) -> PairRow:
    pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
    ok, configuration, focals = outcome.solved, outcome.configuration, focal_errors(outcome)
    matrix = estimate.F[0].flatten().tolist() if estimate is not None and ok else None
    return PairRow(
        pair=pair.identity, key=pair.key, family=pair.family, scene=pair.scene, ok=ok, reason=outcome.reason,
        corrs=int(estimate.inliers.sum()) if estimate is not None else 0,
        corrs_before=int(c.mask.sum()) if c is not None else 0,
        features0=outcome.features[0], features1=outcome.features[1],
        draws=int(estimate.draws[0]) if estimate is not None else 0,
        **{f"seconds_{stage}": outcome.seconds.get(stage, math.nan) for stage in STAGES}, seconds_metrics=seconds,
        F=matrix if corner_error is None else None, H=None if corner_error is None else matrix,
        corner_error=corner_error,
        significance=float(cast(Tensor, estimate.significance)[0]) if estimate is not None and ok else None,
        related=bool(estimate.related[0]) if estimate is not None else False, **figures,
        rotation_error=pose.rotation, translation_error=pose.translation, pose_reason=pose.reason,
        configuration=None if configuration is None else configuration.names[0],
        warning=outcome.not_examined or None if configuration is None else configuration.warnings[0],
        focal_error0=focals.error[0], focal_error1=focals.error[1],
        focal_log_ratio0=focals.log_ratio[0], focal_log_ratio1=focals.log_ratio[1],
    )  # fmt: skip
