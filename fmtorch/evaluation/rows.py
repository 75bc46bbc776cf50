"""Outcomes -> rows: the metrics of a batch of pairs, with stages' seconds and reasons beside them."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence

import torch

from fmtorch import metrics
from fmtorch.pipeline import STAGES, Outcome
from fmtorch.storage import PairRow


def evaluate(outcomes: Sequence[Outcome], seed: int = 0) -> list[PairRow]:
    """One row a pair. NSGD is 1 where the pipeline failed; an inlier rate is NaN where it is not defined."""
    start = time.perf_counter()
    outcomes = [_on_cpu(outcome) for outcome in outcomes]
    figures = [_figures(outcome, seed) for outcome in outcomes]
    seconds = (time.perf_counter() - start) / max(len(outcomes), 1)
    return [_row(outcome, values, seconds) for outcome, values in zip(outcomes, figures, strict=True)]


def _on_cpu(outcome: Outcome) -> Outcome:
    """The outcome with its tensors on the CPU: metrics are float64, and a row's worth of work needs no GPU."""
    c, estimate = outcome.correspondences, outcome.estimate
    return dataclasses.replace(
        outcome,
        correspondences=None if c is None else c.to("cpu"),
        estimate=None if estimate is None else estimate.to("cpu"),
    )


def _figures(outcome: Outcome, seed: int) -> dict[str, float]:
    c, estimate = outcome.correspondences, outcome.estimate
    if c is None or c.size0 is None or c.size1 is None:
        return {"nsgd": 1.0, "nsgd_released": 1.0, "inlier_rate": math.nan, "inlier_rate_before": math.nan}
    F_true = torch.from_numpy(outcome.pair.F)[None]
    solved = estimate is not None and bool(estimate.ok[0])
    inside = estimate.inliers if estimate is not None else torch.zeros_like(c.mask)
    before, after = metrics.inlier_rate(F_true, c.x0, c.x1, inside, c.size0, c.size1, mask=c.mask)
    sgd = {"nsgd": 1.0, "nsgd_released": 1.0}
    if estimate is not None and solved:
        arguments = (F_true, estimate.F, c.size0, c.size1)
        sgd["nsgd"] = float(metrics.nsgd(*arguments, seed=seed, key=c.keys))
        sgd["nsgd_released"] = float(metrics.nsgd_released(*arguments, seed=seed, key=c.keys))
    return {**sgd, "inlier_rate": float(after) if solved else math.nan, "inlier_rate_before": float(before)}


def _row(outcome: Outcome, figures: dict[str, float], seconds: float) -> PairRow:
    pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
    ok = estimate is not None and bool(estimate.ok[0])
    return PairRow(
        pair=pair.identity, key=pair.key, family=pair.family, scene=pair.scene, ok=ok, reason=outcome.reason,
        corrs=int(estimate.inliers.sum()) if estimate is not None else 0,
        corrs_before=int(c.mask.sum()) if c is not None else 0,
        features0=outcome.features[0], features1=outcome.features[1],
        draws=int(estimate.draws[0]) if estimate is not None else 0,
        **{f"seconds_{stage}": outcome.seconds.get(stage, math.nan) for stage in STAGES}, seconds_metrics=seconds,
        F=estimate.F[0].flatten().tolist() if estimate is not None and ok else None, **figures,
    )  # fmt: skip
