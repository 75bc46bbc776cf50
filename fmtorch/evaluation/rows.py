"""Outcomes -> rows: the metrics of a batch of pairs, with stages' seconds and reasons beside them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import cast

from torch import Tensor

from fmtorch import metrics
from fmtorch.evaluation.focals import focal_errors
from fmtorch.evaluation.outcomes import joined_correspondences, joined_estimates, joined_true
from fmtorch.evaluation.planes import plane_figures
from fmtorch.evaluation.poses import PairPose, pose_errors
from fmtorch.pipeline.pipeline import STAGES, Outcome
from fmtorch.storage import PairRow


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
