"""Pairs of a COLMAP database as correspondences, and their estimates as its two-view geometries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate, pair_key
from fmtorch.geometry.configuration import GENERAL, IDENTICAL, PLANAR, ROTATION
from fmtorch.pipeline.camera_arguments import UNKNOWN
from fmtorch.pipeline.configuration import FOCAL_DEVIATION, classify
from fmtorch.storage.exchange.database_images import DatabaseImage
from fmtorch.storage.exchange.two_view import Kind, PairGeometry

Cameras = Literal["stored", "shared", "unknown"]
"""What is taken for known: the cameras of the database, that both images have one focal length, or nothing."""
KINDS: dict[int, Kind] = {PLANAR: "planar", ROTATION: "panoramic", IDENTICAL: "planar_or_panoramic"}
MAX_CONFLICT = 3.0  # deviations, of an estimated focal length from that of a camera that counts as calibrated


class DatabasePair(NamedTuple):
    """A pair of images with its matches, keypoints (n, 2) of both."""

    image0: DatabaseImage
    image1: DatabaseImage
    matches: NDArray[np.int64]


def as_correspondences(pair: DatabasePair, cameras: Cameras) -> Correspondences:
    """The pair as a batch of one, with what is known of its cameras; of pinholes where these are those stored.

    Without image sizes nothing is asked of cameras. Raises ValueError where a stored camera is none that there can be,
    or where the size of one image alone is known.
    """
    images, stored = (pair.image0, pair.image1), cameras == "stored"
    problem = next((image.problem for image in images if image.problem), "") if stored else ""
    if problem:
        raise ValueError(problem)
    fields: dict[str, Any] = {}
    for i, image in enumerate(images):
        points = (image.pinhole if stored else image.points)[pair.matches[:, i]]
        fields[f"x{i}"] = torch.from_numpy(points)[None]
        if image.size is not None:
            fields[f"size{i}"] = torch.tensor([image.size])
        if stored and image.K is not None:
            fields[f"K{i}"] = torch.from_numpy(image.K)[None]
    mask = torch.isfinite(fields["x0"]).all(-1) & torch.isfinite(fields["x1"]).all(-1)
    if any(image.size is not None for image in images):
        focal = [(1.0, image.deviation) for image in images] if stored else [UNKNOWN, UNKNOWN]
        fields["focal"] = torch.tensor([focal], dtype=torch.float64)
        fields["shared_focal"] = torch.tensor([_shared(*images, cameras)])
    elif cameras == "shared":
        raise ValueError("cameras=shared needs the image sizes: size0 and size1, or K0 and K1")
    key = torch.tensor([pair_key(f"{images[0].name} {images[1].name}")])
    return Correspondences(mask=mask, key=key, **fields)


def _shared(image0: DatabaseImage, image1: DatabaseImage, cameras: Cameras) -> bool:
    """Whether both images are known to have one focal length, which is not known exactly."""
    return cameras == "shared" or (
        cameras == "stored" and image0.camera_id == image1.camera_id and image0.deviation > 0
    )


def geometries(
    pairs: Sequence[DatabasePair], c: Correspondences, estimate: Estimate, seed: int = 0
) -> list[PairGeometry]:
    """What the database gets to know of a batch of pairs.

    Of general pairs F, its inliers, E and the pose; of others the homography and its inliers, and the pose where the
    cameras are known or only turn. A pair is calibrated where both focal lengths are known and the matches agree.
    """
    calibrated = torch.zeros(len(c), dtype=torch.bool)
    if c.focal is not None and estimate.R is not None:
        known = c.focal[..., 1].isfinite().all(1)
        calibrated = known & estimate.R.isfinite().flatten(1).all(1) & ~_conflicting(c, estimate)
    configuration = classify(c, estimate, focal_deviation=0, seed=seed)
    kind, homography, rotation = configuration.kind, configuration.homography, configuration.evidence.R
    kinds = np.where(kind != GENERAL, kind, torch.where(estimate.related, GENERAL, -1))
    results = []
    for i, (pair, what) in enumerate(zip(pairs, kinds.tolist(), strict=True)):
        n = len(pair.matches)
        of_lines = what == GENERAL or (what == PLANAR and bool(calibrated[i]))
        inliers = pair.matches[(estimate if of_lines else homography).inliers[i, :n].numpy()]
        H = _known(homography.F[i], homography.ok[i])
        if what == GENERAL:
            name: Kind = "calibrated" if calibrated[i] else "uncalibrated"
            results.append(_general(name, inliers, estimate, i, H))
        elif of_lines:
            results.append(_general("planar", inliers, estimate, i, H))
        elif what not in KINDS:
            results.append(PairGeometry("degenerate", pair.matches[:0]))
        elif what == ROTATION:
            results.append(PairGeometry("panoramic", inliers, H=H, R=rotation[i].numpy(), t=np.zeros(3)))
        else:
            results.append(PairGeometry(KINDS[what], inliers, H=H))
    return results


def _general(kind: Kind, inliers: NDArray[np.int64], estimate: Estimate, i: int, H: Any) -> PairGeometry:
    """A geometry with F, and the pose where there is one."""
    E, R, t = (
        None if value is None else _known(value[i], value[i].isfinite().all())
        for value in (estimate.E, estimate.R, estimate.t)
    )
    return PairGeometry(kind, inliers, estimate.F[i].double().numpy(), E, H, R, t)


def _known(value: Tensor, known: Tensor) -> NDArray[np.float64] | None:
    return value.double().numpy() if known else None


def _conflicting(c: Correspondences, estimate: Estimate) -> Tensor:
    """Whether an estimated focal length contradicts the known one of K: (b,)."""
    if c.K0 is None or c.K1 is None or c.focal is None or estimate.focals is None:
        return torch.zeros(len(c), dtype=torch.bool)
    stored = torch.stack([torch.sqrt(K[:, 0, 0] * K[:, 1, 1]) for K in (c.K0, c.K1)], 1)
    apart = (estimate.focals / stored).log().abs()
    return (apart > MAX_CONFLICT * c.focal[..., 1].clamp_min(FOCAL_DEVIATION)).any(1)
