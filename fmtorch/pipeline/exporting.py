"""What a pipeline made of pairs, kept for export: keypoints of images, matches, F and inliers of pairs."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.geometry import cross_matrix, pose_from_fundamental
from fmtorch.io.match_store import MatchRecords, PairGeometry, StoredImage, StoredPair, indices
from fmtorch.pipeline.pair_geometries import pair_geometries
from fmtorch.pipeline.photographs import PhotographCamera
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.pipeline.two_images import Described, MatchResult
from fmtorch.two_view.pair_type import PairTypes

EXACT = (1.0, 0.0)  # px, relative deviation; K stands for the pixels


def match_records(pipeline: Pipeline, outcomes: Sequence[Outcome]) -> MatchRecords:
    """The outcomes' images and pairs for a `MatchStore`, by the paths of images; pairs of no use are left out."""
    records = MatchRecords({}, {})
    for outcome in outcomes:
        pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
        if not exportable(pair) or c is None or estimate is None:
            continue
        ends = pair.image0.path, pair.image1.path
        for image, K in ((pair.image0, pair.K0), (pair.image1, pair.K1)):
            if image.path not in records.images:
                records.images[image.path] = _stored_image(pipeline, image, K)
        F = estimate.F[0] if outcome.solved else torch.zeros(3, 3)
        points = records.images[ends[0]].points, records.images[ends[1]].points
        matched = c if outcome.keypoints is None else outcome.keypoints
        kept = _pair((str(ends[0]), str(ends[1])), points, matched, F, estimate.inliers[0], bool(estimate.related[0]))
        if outcome.pair_type is not None:
            kept = dataclasses.replace(kept, geometry=_geometry(kept.matches, c, estimate, outcome.pair_type))
        records.pairs[ends] = kept
    return records


def _geometry(matches: NDArray[np.int32], c: Correspondences, estimate: Estimate, pair_type: PairTypes) -> PairGeometry:
    """The geometry of one pair for COLMAP, whose surviving matches are these keypoints, (m, 2).
    Where the estimator was given nothing of cameras that are known, and F is determined, the pose is that of F."""
    if not c.asks_for_cameras and c.K0 is not None and c.K1 is not None and bool(pair_type.determined[0]):
        ends = estimate.F.double(), c.K0.double(), c.K1.double(), c.x0.double(), c.x1.double()
        pose = pose_from_fundamental(*ends, estimate.inliers & c.mask)
        estimate = estimate.derived(E=cross_matrix(pose.t) @ pose.R, R=pose.R, t=pose.t)
        c = c.derived(focal=torch.tensor([[EXACT, EXACT]], dtype=torch.float64, device=c.mask.device))
    index = np.zeros((c.mask.shape[1], 2), np.int32)
    index[c.mask[0].cpu().numpy()] = matches
    (geometry,) = pair_geometries([index], c, estimate, pair_type)
    return geometry


def exportable(pair: ImagePair) -> bool:
    """Whether a pair has images, as stored, that a pipeline finds keypoints in: not of a broken one, nor of given
    matches, nor where images are resized or turned when read."""
    resampled = pair.image0.resampling is not None or pair.image1.resampling is not None
    return pair.problem is None and pair.matches is None and not resampled


def exported_image(name: str, described: Described, camera: PhotographCamera | None = None) -> StoredImage:
    """A photograph's keypoints, with what is known of its camera, as a journal keeps them."""
    scores = described.features.scores.detach().cpu().float().numpy()
    lens = None if camera is None else camera.lens
    focal = None if camera is None or camera.focal is None else camera.focal[0]
    bends = lens is not None and lens.bends
    K = None if lens is None or bends else lens.K
    return StoredImage(name, _points(described), scores, described.size, K, lens if bends else None, focal)


def exported_match(names: tuple[str, str], described: tuple[Described, Described], result: MatchResult) -> StoredPair:
    """What was found of two photographs, as a journal keeps it."""
    points = _points(described[0]), _points(described[1])
    keypoints = result.putative.derived(mask=result.kept[None]).compact()
    pair = _pair(names, points, keypoints, result.F, result.inliers, result.related)
    if (geometry := result.geometry) is not None:
        geometry = geometry._replace(inliers=pair.matches[geometry.inliers[:, 0]])
    return dataclasses.replace(pair, geometry=geometry, significance=result.significance, pair_type=result.pair_type)


def _points(described: Described) -> NDArray[np.float32]:
    return described.points.detach().cpu().float().numpy()


def _stored_image(pipeline: Pipeline, image: ImageSource, K: NDArray[np.float64] | None) -> StoredImage:
    features, _ = pipeline.features(image)
    h, w = (int(n) for n in features.image_size)
    points, scores = (value.detach().cpu().float().numpy() for value in (features.keypoints, features.scores))
    return StoredImage(str(image.path), points, scores, (h, w), K)


def _pair(
    names: tuple[str, str], points: tuple[NDArray[np.float32], NDArray[np.float32]],
    c: Correspondences, F: Tensor, inliers: Tensor, related: bool,
) -> StoredPair:  # fmt: skip
    """The surviving matches of one pair, as the matcher left them, as indices of the images' points.
    Scores are the matcher's, or 1 - ratio, and 1 where there is neither. Raises ValueError for matches that are at no
    keypoint."""
    mask = c.mask[0].cpu()
    ends = (x[0].detach().cpu().float()[mask].numpy() for x in (c.x0, c.x1))
    index = [indices(keypoints, x) for keypoints, x in zip(points, ends, strict=True)]
    ambiguity = torch.zeros(len(mask)) if c.ambiguity is None else c.ambiguity[0].detach().cpu().float()
    scores = (1 - ambiguity[mask]).nan_to_num(0.0).clamp(0.0, 1.0)
    return StoredPair(
        *names, np.stack(index, -1).astype(np.int32), scores.numpy(), inliers.cpu()[mask].numpy(),
        F.detach().cpu().double().numpy(), related,
    )  # fmt: skip
