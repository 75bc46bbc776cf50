"""Estimates of pairs and their pair types as the two-view geometries of COLMAP's databases."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.pair_type import GENERAL, IDENTICAL, PLANAR, ROTATION
from fmtorch.io.match_store import Kind, PairGeometry
from fmtorch.two_view.pair_type import FOCAL_DEVIATION, PairTypes, warnings_of

KINDS: dict[int, Kind] = {PLANAR: "planar", ROTATION: "panoramic", IDENTICAL: "planar_or_panoramic"}
MAX_CONFLICT = 3.0  # deviations, of an estimated focal length from that of a camera that counts as calibrated


def pair_geometries(
    matches: Sequence[NDArray[np.integer[Any]]], c: Correspondences, estimate: Estimate, pair_type: PairTypes
) -> list[PairGeometry]:
    """The geometries of a batch of pairs, whose matches are keypoints (n, 2) of both images.
    Of general pairs F, its inliers, and E and the pose where there is one; of others the homography and its inliers,
    and the pose where the cameras are known or only turn. A pair is calibrated where both focal lengths are known and
    the matches agree; one whose support is not beyond chance is degenerate. c: the same matches, with what the
    estimator was given of their cameras."""
    calibrated = _calibrated(c, estimate)
    said = [*zip(estimate.reason, warnings_of(estimate, pair_type), strict=True)]
    kind, homography = pair_type.kind, pair_type.homography
    kinds = torch.where(kind != GENERAL, kind, torch.where(estimate.related, GENERAL, -1)).tolist()
    results = []
    for i, (index, what) in enumerate(zip(matches, kinds, strict=True)):
        of_lines = what == GENERAL or (what == PLANAR and bool(calibrated[i]))
        inliers = index[(estimate if of_lines else homography).inliers[i, : len(index)].cpu().numpy()]
        H = _known(homography.F[i], homography.ok[i])
        if what == GENERAL:
            results.append(_with_lines("calibrated" if calibrated[i] else "uncalibrated", inliers, estimate, i, H))
        elif of_lines:
            results.append(_with_lines("planar", inliers, estimate, i, H))
        elif what not in KINDS:
            results.append(PairGeometry("degenerate", index[:0]))
        elif what == ROTATION:
            R = pair_type.evidence.R[i].cpu().numpy()
            results.append(PairGeometry("panoramic", inliers, H=H, R=R, t=np.zeros(3)))
        else:
            results.append(PairGeometry(KINDS[what], inliers, H=H))
    return [geometry._replace(reason=why, warning=but) for geometry, (why, but) in zip(results, said, strict=True)]


def _calibrated(c: Correspondences, estimate: Estimate) -> Tensor:
    """Whether both focal lengths of a pair are known, and the pose with them: (b,)."""
    if c.focal is None or estimate.R is None:
        return torch.zeros_like(estimate.ok)
    return c.focal[..., 1].isfinite().all(1) & estimate.R.isfinite().flatten(1).all(1) & ~_conflicting(c, estimate)


def _with_lines(kind: Kind, inliers: NDArray[np.integer[Any]], estimate: Estimate, i: int, H: Any) -> PairGeometry:
    pose = estimate.E, estimate.R, estimate.t
    E, R, t = (None if value is None else _known(value[i], value[i].isfinite().all()) for value in pose)
    return PairGeometry(kind, inliers, estimate.F[i].detach().cpu().double().numpy(), E, H, R, t)


def _known(value: Tensor, known: Tensor) -> NDArray[np.float64] | None:
    return value.detach().cpu().double().numpy() if known else None


def _conflicting(c: Correspondences, estimate: Estimate) -> Tensor:
    """Whether an estimated focal length contradicts the known one of K: (b,)."""
    if c.K0 is None or c.K1 is None or c.focal is None or estimate.focals is None:
        return torch.zeros_like(estimate.ok)
    stored = torch.stack([torch.sqrt(K[:, 0, 0] * K[:, 1, 1]) for K in (c.K0, c.K1)], 1)
    return ((estimate.focals / stored).log().abs() > MAX_CONFLICT * c.focal[..., 1].clamp_min(FOCAL_DEVIATION)).any(1)
