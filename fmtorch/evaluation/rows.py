"""Outcomes -> rows: the errors of each pair's F or homography, of its pose and its focal lengths, with seconds.

Metrics are float64 and computed on the CPU: so little work needs no GPU.
"""

import functools
import math
import time
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch import metrics
from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.data.pairs import ImagePair
from fmtorch.io.oanet import GEODESIC, geodesic
from fmtorch.pipeline.pipeline import STAGES, Outcome
from fmtorch.runs import PairRow

LARGEST_ROTATION, LARGEST_TRANSLATION = 180.0, 90.0  # degrees: what a failed pair counts as, 180 with the sign of t
Figures = dict[str, Any]  # fields of `PairRow`


def evaluate(outcomes: Sequence[Outcome], seed: int = 0, signed: bool = False) -> list[PairRow]:
    """One row a pair. NSGD is 1 where the pipeline failed; an inlier rate is NaN where it is not defined.
    Pairs of known homographies have corner errors in place of NSGD and poses. signed: of `pose_errors`."""
    rows: dict[int, PairRow] = {}
    for planar in (False, True):
        index = [i for i, outcome in enumerate(outcomes) if (outcome.pair.H is not None) == planar]
        own = [outcomes[i] for i in index]
        start = time.perf_counter()
        figures = _of_homographies(own) if planar else _of_fundamental_matrices(own, seed, signed)
        seconds = (time.perf_counter() - start) / max(len(own), 1)
        rows |= {i: _row(o, each, planar, seconds) for i, o, each in zip(index, own, figures, strict=True)}
    return [rows[i] for i in range(len(outcomes))]


def _joined(outcomes: Sequence[Outcome]) -> tuple[Correspondences, Estimate, tuple[Tensor, Tensor]]:
    """Correspondences and estimates of outcomes that have both, as batches on the CPU, and the sizes of images."""
    c = collate([o.correspondences.to("cpu") for o in outcomes if o.correspondences is not None])
    if c.size0 is None or c.size1 is None:
        raise ValueError("correspondences come without image sizes (size0, size1); the matcher must supply them")
    return c, collate([o.estimate.to("cpu") for o in outcomes if o.estimate is not None]), (c.size0, c.size1)


def _truth(outcomes: Sequence[Outcome], *names: str) -> list[Tensor]:
    """What is true of each pair, by its names in `ImagePair`, float64."""
    values = ([np.asarray(getattr(o.pair, name), np.float64) for o in outcomes] for name in names)
    return [torch.from_numpy(np.stack(each)) for each in values]


def _matched(outcomes: Sequence[Outcome]) -> list[int]:
    return [i for i, o in enumerate(outcomes) if o.estimate is not None and o.correspondences is not None]


def _of_fundamental_matrices(outcomes: Sequence[Outcome], seed: int, signed: bool) -> list[Figures]:
    """NSGD in both forms, inlier rates before and, where the pair was solved, after estimation, and pose errors."""
    undefined = {"nsgd": 1.0, "nsgd_released": 1.0, "inlier_rate_before": math.nan, "inlier_rate": math.nan}
    figures: list[Figures] = [{**undefined} for _ in outcomes]
    if solved := [i for i, o in enumerate(outcomes) if o.solved]:
        own = [outcomes[i] for i in solved]
        (c, estimate, sizes), (F,) = _joined(own), _truth(own, "F")
        for name, distance in (("nsgd", metrics.nsgd), ("nsgd_released", metrics.nsgd_released)):
            values = distance(F, estimate.F, *sizes, seed=seed, key=c.keys).tolist()
            for i, value in zip(solved, values, strict=True):
                figures[i][name] = value
    if matched := _matched(outcomes):
        own = [outcomes[i] for i in matched]
        (c, estimate, sizes), (F,) = _joined(own), _truth(own, "F")
        rates = metrics.inlier_rate(F, c.x0, c.x1, estimate.inliers, *sizes, mask=c.mask)
        for i, before, after in zip(matched, rates.before.tolist(), rates.after.tolist(), strict=True):
            figures[i] |= {"inlier_rate_before": before, "inlier_rate": after if outcomes[i].solved else math.nan}
    poses = pose_errors(outcomes, signed)
    return [each | p | _by_labels(o) for each, p, o in zip(figures, poses, outcomes, strict=True)]


def _by_labels(outcome: Outcome) -> Figures:
    """Precision and recall of the estimator's inliers, of given matches of known cameras, zero where a pair failed.
    Right are those of a geodesic distance below 1e-4; recall is of all given matches, before pruning."""
    pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
    if pair.matches is None or _unknown(pair) is not None:
        return {}
    if c is None or estimate is None:
        return {"match_precision": 0.0, "match_recall": 0.0}
    kept = (estimate.inliers & c.mask)[0].cpu().numpy()
    right, total = _right(pair, c)[kept].sum(), _right(pair, pair.matches().correspondences).sum()
    return {"match_precision": float(right / max(kept.sum(), 1)), "match_recall": float(right / max(total, 1))}


def _right(pair: ImagePair, c: Correspondences) -> NDArray[np.bool_]:
    """Which matches (n,) of a batch of one have a geodesic distance below OANet's threshold."""
    K0, K1, R, t = (cast(NDArray[np.float64], value) for value in (pair.K0, pair.K1, pair.R, pair.t))
    distance = geodesic(R, t, K0, K1, *(x[0].double().cpu().numpy() for x in (c.x0, c.x1)))
    right: NDArray[np.bool_] = (distance < GEODESIC) & c.mask[0].cpu().numpy()
    return right


def _of_homographies(outcomes: Sequence[Outcome]) -> list[Figures]:
    """Corner errors in pixels, infinite where a pair failed, and the shares of right matches, NaN if undefined."""
    rates = {"inlier_rate_before": math.nan, "inlier_rate": math.nan}
    figures: list[Figures] = [{"nsgd": math.nan, "corner_error": math.inf, **rates} for _ in outcomes]
    if matched := _matched(outcomes):
        own = [outcomes[i] for i in matched]
        (c, estimate, (size0, _)), (H,) = _joined(own), _truth(own, "H")
        errors = torch.where(estimate.ok, metrics.corner_error(estimate.F, H, size0), torch.inf)
        right, kept = metrics.right_of_homography(H, c.x0, c.x1, mask=c.mask), estimate.inliers & c.mask
        before = right.sum(-1).double() / c.mask.sum(-1)
        after = torch.where(estimate.ok, (right & kept).sum(-1).double() / kept.sum(-1), torch.nan)
        for i, error, a, b in zip(matched, errors.tolist(), before.tolist(), after.tolist(), strict=True):
            figures[i] |= {"corner_error": error, "inlier_rate_before": a, "inlier_rate": b}
    return figures


def _row(outcome: Outcome, figures: Figures, planar: bool, seconds: float) -> PairRow:
    pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
    ok, pair_type = outcome.solved, outcome.pair_type
    lenses = (None, None, None) if estimate is None else _lenses(estimate)
    matrix = estimate.F[0].flatten().tolist() if estimate is not None and ok else None
    figures = figures | {f"seconds_{stage}": outcome.seconds.get(stage, math.nan) for stage in STAGES}
    return PairRow(
        pair=pair.identity, key=pair.key, family=pair.family, scene=pair.scene, ok=ok, reason=outcome.reason,
        corrs=int(estimate.inliers.sum()) if estimate is not None else 0,
        corrs_before=int(c.mask.sum()) if c is not None else 0,
        features0=outcome.features[0], features1=outcome.features[1],
        samples=int(estimate.samples[0]) if estimate is not None else 0,
        seconds_metrics=seconds, F=None if planar else matrix, H=matrix if planar else None, **figures,
        significance=float(cast(Tensor, estimate.significance)[0]) if estimate is not None and ok else None,
        related=bool(estimate.related[0]) if estimate is not None else False,
        pair_type=None if pair_type is None else pair_type.names[0],
        warning=outcome.not_examined or None if pair_type is None else pair_type.warnings[0],
        **focal_errors(outcome), lens_suggested=lenses[0], lens0=lenses[1], lens1=lenses[2],
    )  # fmt: skip


def _lenses(estimate: Estimate) -> list[float | None]:
    """Lambda of the lens that is suggested, and of those that are estimated; None where not determined."""
    unknown = [math.nan, math.nan]
    suggested = [math.nan] if estimate.lens_suggested is None else estimate.lens_suggested.tolist()
    values = suggested + (unknown if estimate.lens is None else estimate.lens[0].tolist())
    return [None if math.isnan(value) else value for value in values]


def pose_errors(outcomes: Sequence[Outcome], signed: bool = False) -> list[Figures]:
    """The pose error of each pair: of the estimate's R and t, or else of its F, K0, K1 and the estimator's inliers.
    See `pose_error` and `fundamental_pose_error`. A pair without F, or without a pose, has the largest errors and a
    reason; one whose calibration or motion is unknown has a reason only. signed: the sign of the translation counts,
    and of the four poses of F the best one: `closest_pose_error`."""
    poses = [Figures(pose_reason=_unknown(outcome.pair)) for outcome in outcomes]
    known = [i for i, pose in enumerate(poses) if pose["pose_reason"] is None]
    solved = [i for i in known if outcomes[i].solved]
    own_pose = functools.partial(_of_pose, up_to_sign=not signed), "the pose is not determined"
    of_F = (_closest, "F has no pose") if signed else (_of_fundamental, "no inlier in front of both cameras")
    for estimated, (error_of, reason) in ((True, own_pose), (False, of_F)):
        own = [i for i in solved if (cast(Estimate, outcomes[i].estimate).R is not None) == estimated]
        error = error_of([outcomes[i] for i in own]) if own else metrics.PoseError(torch.zeros(0), torch.zeros(0))
        for i, rotation, translation in zip(own, error.rotation.tolist(), error.translation.tolist(), strict=True):
            poses[i] |= {"rotation_error": rotation, "translation_error": translation}
            poses[i]["pose_reason"] = reason if rotation >= LARGEST_ROTATION else None
    largest = LARGEST_ROTATION if signed else LARGEST_TRANSLATION
    lost = {"rotation_error": LARGEST_ROTATION, "translation_error": largest, "pose_reason": "no F"}
    return [lost if i in known and not outcomes[i].solved else pose for i, pose in enumerate(poses)]


def _unknown(pair: ImagePair) -> str | None:
    values = {"K0": pair.K0, "K1": pair.K1, "R": pair.R, "t": pair.t}
    if missing := [name for name, value in values.items() if value is None]:
        return f"{', '.join(missing)} unknown"
    broken = [name for name, value in values.items() if not np.isfinite(cast(NDArray[np.float64], value)).all()]
    return f"{', '.join(broken)} not finite" if broken else None


def _of_pose(outcomes: Sequence[Outcome], up_to_sign: bool) -> metrics.PoseError:
    (_, estimate, _), (R, t) = _joined(outcomes), _truth(outcomes, "R", "t")
    own = cast(Tensor, estimate.R).double(), cast(Tensor, estimate.t).double()
    return metrics.pose_error(*own, R, t, up_to_sign=up_to_sign)


def _of_fundamental(outcomes: Sequence[Outcome]) -> metrics.PoseError:
    (c, estimate, _), (K0, K1, R, t) = _joined(outcomes), _truth(outcomes, "K0", "K1", "R", "t")
    return metrics.fundamental_pose_error(estimate.F.double(), K0, K1, c.x0, c.x1, R, t, estimate.inliers & c.mask)


def _closest(outcomes: Sequence[Outcome]) -> metrics.PoseError:
    _, estimate, _ = _joined(outcomes)
    return metrics.closest_pose_error(estimate.F.double(), *_truth(outcomes, "K0", "K1", "R", "t"))


def focal_errors(outcome: Outcome) -> Figures:
    """Of both images ``|f - f_true| / f_true`` and ``log(f / f_true)``, by what the estimator was given of the pair.
    None of these where no focal length was estimated, since it was given exactly or nobody asked, or the true one is
    not known. Where it was to be estimated and is not determined the error is infinite and there is no ratio."""
    c, estimate, figures = outcome.correspondences, outcome.estimate, Figures()
    for i, K in enumerate((outcome.pair.K0, outcome.pair.K1)):
        true = _focal(K)
        if estimate is None or c is None or c.focal is None or true is None or float(c.focal[0, i, 1]) == 0:  # exact
            continue
        focal = math.nan if estimate.focals is None or not outcome.solved else float(estimate.focals[0, i])
        figures[f"focal_error{i}"] = math.inf
        if math.isfinite(focal) and focal > 0:
            figures |= {f"focal_error{i}": abs(focal - true) / true, f"focal_log_ratio{i}": math.log(focal / true)}
    return figures


def _focal(K: NDArray[np.float64] | None) -> float | None:
    """The focal length of a calibration, px: the geometric mean of those along x and y."""
    if K is None or not np.isfinite(K).all():
        return None
    product = float(K[0, 0] * K[1, 1]) / float(K[2, 2]) ** 2 if K[2, 2] else 0.0
    return math.sqrt(product) if product > 0 else None
