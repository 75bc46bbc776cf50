"""What a pipeline made of pairs, kept for export: keypoints of images, matches, F and inliers of pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.pipeline.two_images import Described, MatchResult
from fmtorch.storage.exchange.journal import ExportedImage, ExportedPair, Journal, indices


def keep_outcomes(journal: Journal, pipeline: Pipeline, outcomes: Sequence[Outcome]) -> None:
    """Add the outcomes' images and pairs to a journal; pairs that cannot be used, and what it has, are left out."""
    for outcome in outcomes:
        pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
        ends = pair.image0.path, pair.image1.path
        if not exportable(pair) or c is None or estimate is None or journal.has_pair(*ends):
            continue
        for image, K in ((pair.image0, pair.K0), (pair.image1, pair.K1)):
            _keep_image(journal, pipeline, image, K)
        F = estimate.F[0] if outcome.solved else torch.zeros(3, 3)
        names = journal.name(ends[0]), journal.name(ends[1])
        points = journal.image(ends[0]).points, journal.image(ends[1]).points
        journal.add_pair(*ends, _pair(names, points, c, F, estimate.inliers[0], bool(estimate.related[0])))


def exportable(pair: ImagePair) -> bool:
    """Whether a pair has images that a pipeline finds keypoints in: not of a broken one, nor of given matches."""
    return pair.problem is None and pair.matches is None


def exported_image(name: str, described: Described) -> ExportedImage:
    """A photograph's keypoints, as a journal keeps them."""
    scores = described.features.scores.detach().cpu().float().numpy()
    return ExportedImage(name, _points(described), scores, described.size)


def exported_match(names: tuple[str, str], described: tuple[Described, Described], result: MatchResult) -> ExportedPair:
    """What was found of two photographs, as a journal keeps it."""
    points = _points(described[0]), _points(described[1])
    pair = _pair(names, points, result.correspondences, result.F, result.inliers, result.related)
    return dataclasses.replace(pair, significance=result.significance, configuration=result.configuration)


def _points(described: Described) -> NDArray[np.float32]:
    return described.points.detach().cpu().float().numpy()


def _keep_image(journal: Journal, pipeline: Pipeline, image: ImageSource, K: NDArray[np.float64] | None) -> None:
    if journal.has_image(image.path):
        return
    features, _ = pipeline.features(image)
    h, w = (int(n) for n in features.image_size)
    points, scores = (value.detach().cpu().float().numpy() for value in (features.keypoints, features.scores))
    journal.add_image(image.path, ExportedImage(journal.name(image.path), points, scores, (h, w), K))


def _pair(
    names: tuple[str, str], points: tuple[NDArray[np.float32], NDArray[np.float32]],
    c: Correspondences, F: Tensor, inliers: Tensor, related: bool,
) -> ExportedPair:  # fmt: skip
    """The surviving matches of one pair as indices of the images' points.

    Scores are one less the matcher's figure, a ratio, and 1 where there is none. Raises ValueError for matches that are
    at no keypoint.
    """
    mask = c.mask[0].cpu()
    index = [
        indices(those, x[0].detach().cpu().float()[mask].numpy()) for those, x in zip(points, (c.x0, c.x1), strict=True)
    ]
    quality = torch.zeros(len(mask)) if c.quality is None else c.quality[0].detach().cpu().float()
    scores = (1 - quality[mask]).nan_to_num(0.0).clamp(0.0, 1.0)
    return ExportedPair(
        *names, np.stack(index, -1).astype(np.int32), scores.numpy(), inliers.cpu()[mask].numpy(),
        F.detach().cpu().double().numpy(), related,
    )  # fmt: skip
