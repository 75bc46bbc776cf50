"""What a pipeline made of pairs, kept for export: keypoints of images, matches, F and inliers of pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.evaluation.outcomes import solved
from fmtorch.exchange.journal import ExportedImage, ExportedPair, Journal, indices
from fmtorch.pipeline import Outcome, Pipeline
from fmtorch.types import Correspondences, Features


def keep_outcomes(journal: Journal, pipeline: Pipeline, outcomes: Sequence[Outcome]) -> None:
    """Add the outcomes' images and pairs to a journal; pairs that cannot be used, and what it has, are left out."""
    for outcome in outcomes:
        pair = outcome.pair
        ends = pair.image0.path, pair.image1.path
        if not exportable(pair) or outcome.correspondences is None or journal.has_pair(*ends):
            continue
        for image, K in ((pair.image0, pair.K0), (pair.image1, pair.K1)):
            keep_image(journal, pipeline, image, K)
        F = outcome.estimate.F[0] if outcome.estimate is not None and solved(outcome) else torch.zeros(3, 3)
        inliers = outcome.estimate.inliers[0] if outcome.estimate is not None else None
        journal.add_pair(*ends, exported_pair(journal, ends, outcome.correspondences, F, inliers))


def exportable(pair: ImagePair) -> bool:
    """Whether a pair has images that a pipeline finds keypoints in: not of a broken one, nor of given matches."""
    return pair.problem is None and pair.matches is None


def keep_image(journal: Journal, pipeline: Pipeline, image: ImageSource, K: np.ndarray | None) -> None:
    """Add an image's keypoints to a journal, unless it has them."""
    if not journal.has_image(image.path):
        features, _ = pipeline.features(image)
        journal.add_image(image.path, exported_image(journal.name(image.path), features, features.keypoints, None, K))


def exported_image(
    name: str, features: Features, points: Tensor, size: tuple[int, int] | None, K: np.ndarray | None
) -> ExportedImage:
    """An image's keypoints at these points, in pixels of an image of this size; None: of that which was described."""
    h, w = size or [int(n) for n in features.image_size]
    scores = features.scores.detach().cpu().float().numpy()
    return ExportedImage(name, points.detach().cpu().float().numpy(), scores, (h, w), K)


def exported_pair(
    journal: Journal, ends: tuple, c: Correspondences, F: Tensor, inliers: Tensor | None
) -> ExportedPair:  # fmt: skip
    """The surviving matches of one pair as indices of the images' points.

    Scores are one less the matcher's figure, a ratio, and 1 where there is none. Raises ValueError for matches that are
    at no keypoint.
    """
    live = c.mask[0].cpu()
    index = [
        indices(journal.image(end).points, x[0].detach().cpu().float()[live].numpy())
        for end, x in zip(ends, (c.x0, c.x1), strict=True)
    ]
    quality = torch.zeros_like(live, dtype=torch.float32) if c.quality is None else c.quality[0].detach().cpu().float()
    scores = (1 - quality[live]).nan_to_num(0.0).clamp(0.0, 1.0).numpy()
    kept = torch.zeros(int(live.sum()), dtype=torch.bool) if inliers is None else inliers.cpu()[live]
    name0, name1 = (journal.name(end) for end in ends)
    return ExportedPair(
        name0, name1, np.stack(index, -1).astype(np.int32), scores, kept.numpy(), F.detach().cpu().double().numpy()
    )
