"""Scenes ruled by a plane: models that fit the plane alone, told apart and completed by the parallax of the rest."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core import random
from fmtorch.core.random import Stream
from fmtorch.estimators.models import Models
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.sampling import PriorWeighted, with_replacement
from fmtorch.estimators.scores import Score, score_models
from fmtorch.geometry.homography import (
    least_squares_homography,
    plane_and_parallax,
    plane_homography,
    transfer_squared,
)
from fmtorch.geometry.rank2 import last_right_singular_vector

PLANE_THRESHOLD_PX = 2.0  # px, the greater of the two transfer distances up to which a match lies on a plane
PARALLAX_DRAWS = 200  # pairs of matches off a plane
KEPT = 4  # their best models
FITS = 3  # least-squares fits of a plane to its matches, each to those of the last


class Degensac:
    """DEGENSAC (Chum, Werner & Matas, CVPR 2005): the best model so far is checked, and completed if it is degenerate.

    A sample of seven is H-degenerate when at least five of its matches agree with a homography that is compatible with
    the model; five triplets of the sample give all such homographies. The homography of a degenerate model is fitted to
    all its matches, and fundamental matrices of it and two matches off the plane join the models of the round.
    score: of the engine.
    """

    SAMPLE = 7
    ON_PLANE = 5
    TRIPLETS = ((0, 1, 2), (3, 4, 5), (0, 1, 6), (3, 4, 6), (2, 5, 6))

    def __init__(self, score: Score) -> None:
        self.score = score

    def __call__(self, models: Models, best: Float[Tensor, " p"], pairs: NormalizedPairs) -> Models:
        """The verified models of a round, with those of plane and parallax. best: the score to beat."""
        score = models.score
        assert score is not None
        if not score.shape[1]:  # no sample of any pair gave a model
            return models
        top, order = torch.sort(score, dim=1, descending=True, stable=True)
        rising = top[:, 0] > best
        first = models.take(order[:, :1])
        H, degenerate = self._plane(first.F[..., 0], models.sample_of(first.draw[:, 0]), pairs)
        rows = (rising & degenerate).nonzero()[:, 0]
        if not len(rows):
            return models
        more, more_score = _parallax(_fitted(H[:, rows], pairs[rows]), pairs[rows], self.score, models.start)
        extra = models.F.new_zeros(9, len(score), KEPT)
        extra_score = score.new_full((len(score), KEPT), -torch.inf)
        extra[:, rows], extra_score[rows] = more, more_score
        return dataclasses.replace(
            models,
            F=torch.cat([models.F, extra], 2),
            valid=torch.cat([models.valid, torch.isfinite(extra_score)], 1),
            draw=torch.cat([models.draw, first.draw.expand(-1, KEPT)], 1),
            score=torch.cat([score, extra_score], 1),
        )

    def _plane(
        self, F: Float[Tensor, "9 p"], sample: Int[Tensor, "7 p"], pairs: NormalizedPairs
    ) -> tuple[Float[Tensor, "9 p"], Bool[Tensor, " p"]]:
        """The compatible homography with most matches of the sample, and whether these are enough."""
        points = pairs.points.gather(2, sample.T.expand(4, -1, -1))  # (4, p, 7)
        F = F.to(torch.float64)
        e1 = last_right_singular_vector(F.reshape(3, 3, -1).transpose(0, 1).contiguous())
        triplets = points[:, :, torch.tensor(self.TRIPLETS, device=points.device)].permute(0, 3, 1, 2)  # (4, 3, p, 5)
        count = len(self.TRIPLETS)
        H, valid = plane_homography(F[..., None].expand(-1, -1, count), e1[..., None].expand(-1, -1, count), triplets)
        near = transfer_squared(H, points) <= _limit(pairs)
        members = torch.where(valid, near.sum(-1), 0)
        most = torch.sort(members, dim=1, descending=True, stable=True)
        return H.gather(2, most.indices[:, :1].expand(9, -1, -1))[..., 0], most.values[:, 0] >= self.ON_PLANE


def _limit(pairs: NormalizedPairs) -> Float[Tensor, "p 1 1"]:
    """The squared threshold of a plane in normalised units."""
    return (PLANE_THRESHOLD_PX / pairs.pixels_per_unit).square()[:, None, None]


def _fitted(H: Float[Tensor, "9 p"], pairs: NormalizedPairs) -> Float[Tensor, "9 p"]:
    """Homographies fitted to the matches near them, as long as these become more."""

    def on_plane(H: Tensor) -> Tensor:
        return (transfer_squared(H[..., None], pairs.points) <= _limit(pairs))[:, 0] & pairs.mask

    inside = on_plane(H)
    for _ in range(FITS):
        fit, determined = least_squares_homography(pairs.points, inside.to(torch.float64))
        fit_inside = on_plane(fit)
        better = determined & (fit_inside.sum(-1) > inside.sum(-1))
        H, inside = torch.where(better, fit, H), torch.where(better[:, None], fit_inside, inside)
    return H


def _parallax(
    H: Float[Tensor, "9 p"], pairs: NormalizedPairs, score: Score, turn: int
) -> tuple[Float[Tensor, "9 p kept"], Float[Tensor, "p kept"]]:
    """The best fundamental matrices of a homography and two matches off its plane, float32, and their scores.

    turn: makes the draws others than those of another turn.
    """
    near = (transfer_squared(H[..., None], pairs.points) <= _limit(pairs))[:, 0]
    weight = torch.where(near, 0, PriorWeighted().weight(pairs))
    bits = random.bits(pairs.seed, pairs.key, Stream.PARALLAX, turn * PARALLAX_DRAWS, PARALLAX_DRAWS, 2)
    index = with_replacement(bits.flatten(1), weight).reshape(len(weight), PARALLAX_DRAWS, 2).permute(2, 0, 1)
    points = torch.stack([pairs.points.gather(2, i.expand(4, -1, -1)) for i in index], 1)
    F, valid = plane_and_parallax(H[..., None].expand(-1, -1, PARALLAX_DRAWS), points)
    models = F.to(torch.float32)
    scores = score_models(score, models, pairs)
    scores = scores.masked_fill(~valid | ((weight > 0).sum(-1) < 2)[:, None], -torch.inf)
    top, order = torch.sort(scores, dim=1, descending=True, stable=True)
    return models.gather(2, order[:, :KEPT].expand(9, -1, -1)), top[:, :KEPT]
