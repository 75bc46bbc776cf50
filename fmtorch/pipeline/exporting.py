"""What a pipeline made of pairs, kept for export: keypoints of images, matches, F and inliers of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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
        journal.add_pair(*ends, _pair(journal, ends, c, F, estimate.inliers[0], bool(estimate.related[0])))


def exportable(pair: ImagePair) -> bool:
    """Whether a pair has images that a pipeline finds keypoints in: not of a broken one, nor of given matches."""
    return pair.problem is None and pair.matches is None


def keep_described(journal: Journal, image: Path, described: Described) -> None:
    """Add a photograph's keypoints to a journal."""
    scores = described.features.scores.detach().cpu().float().numpy()
    points = described.points.detach().cpu().float().numpy()
    journal.add_image(image, ExportedImage(journal.name(image), points, scores, described.size))


def keep_match(journal: Journal, ends: tuple[Path, Path], result: MatchResult) -> None:
    """Add what was found of two photographs, whose keypoints the journal has."""
    pair = _pair(journal, ends, result.correspondences, result.F, result.inliers, result.related)
    journal.add_pair(*ends, pair)


def _keep_image(journal: Journal, pipeline: Pipeline, image: ImageSource, K: NDArray[np.float64] | None) -> None:
    if journal.has_image(image.path):
        return
    features, _ = pipeline.features(image)
    h, w = (int(n) for n in features.image_size)
    points, scores = (value.detach().cpu().float().numpy() for value in (features.keypoints, features.scores))
    journal.add_image(image.path, ExportedImage(journal.name(image.path), points, scores, (h, w), K))


def _pair(
    journal: Journal, ends: tuple[Path, Path], c: Correspondences, F: Tensor, inliers: Tensor, related: bool
) -> ExportedPair:
    """The surviving matches of one pair as indices of the images' points.

    Scores are one less the matcher's figure, a ratio, and 1 where there is none. Raises ValueError for matches that are
    at no keypoint.
    """
    mask = c.mask[0].cpu()
    index = [
        indices(journal.image(end).points, x[0].detach().cpu().float()[mask].numpy())
        for end, x in zip(ends, (c.x0, c.x1), strict=True)
    ]
    quality = torch.zeros(len(mask)) if c.quality is None else c.quality[0].detach().cpu().float()
    scores = (1 - quality[mask]).nan_to_num(0.0).clamp(0.0, 1.0)
    name0, name1 = (journal.name(end) for end in ends)
    return ExportedPair(
        name0, name1, np.stack(index, -1).astype(np.int32), scores.numpy(), inliers.cpu()[mask].numpy(),
        F.detach().cpu().double().numpy(), related,
    )  # fmt: skip
