"""Scenes ruled by a plane: models that fit the plane alone, told apart and completed by the parallax of the rest."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch import random
from fmtorch.estimators.problem import Problem
from fmtorch.estimators.sampling import PriorWeighted
from fmtorch.estimators.scoring import Score, score_models
from fmtorch.geometry.homography import (
    least_squares_homography,
    plane_and_parallax,
    plane_homography,
    transfer_squared,
)
from fmtorch.geometry.rank2 import last_right_singular_vector
from fmtorch.random import Stream

PLANE_THRESHOLD = 2.0  # px, the greater of the two transfer distances up to which a match lies on a plane
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

    def __call__(
        self,
        F: Float[Tensor, "9 p k"],
        score: Float[Tensor, "p k"],
        best: Float[Tensor, " p"],
        drawn: Float[Tensor, "9 p m"],
        index: Int[Tensor, "7 p s"],
        problem: Problem,
        start: int,
    ) -> tuple[Float[Tensor, "9 p k2"], Float[Tensor, "p k2"]]:
        """The models of a round and their scores, with those of plane and parallax.

        best: the score to beat. drawn: all models of the round in the order of their draws, index: the samples, start:
        the first draw.
        """
        if not score.shape[1]:  # no sample of any pair gave a model
            return F, score
        top, order = torch.sort(score, dim=1, descending=True, stable=True)
        rising = top[:, 0] > best
        model = F.gather(2, order[:, :1].expand(9, -1, -1))[..., 0]
        place = torch.arange(drawn.shape[2], device=F.device)
        equal = (drawn == model[..., None]).all(0)
        first = torch.where(equal, place, drawn.shape[2]).amin(1).clamp_max(drawn.shape[2] - 1)
        draw = first // (drawn.shape[2] // index.shape[2])
        sample = index.gather(2, draw[None, :, None].expand(self.SAMPLE, -1, -1))[..., 0]
        H, degenerate = self._plane(model, sample, problem)
        rows = (rising & degenerate).nonzero()[:, 0]
        if not len(rows):
            return F, score
        more, more_score = _parallax(_fitted(H[:, rows], problem[rows]), problem[rows], self.score, start)
        extra = F.new_zeros(9, F.shape[1], KEPT)
        extra_score = score.new_full((len(score), KEPT), -torch.inf)
        extra[:, rows], extra_score[rows] = more, more_score
        return torch.cat([F, extra], 2), torch.cat([score, extra_score], 1)

    def _plane(
        self, F: Float[Tensor, "9 p"], sample: Int[Tensor, "7 p"], problem: Problem
    ) -> tuple[Float[Tensor, "9 p"], Bool[Tensor, " p"]]:
        """The compatible homography with most matches of the sample, and whether these are enough."""
        points = problem.points.gather(2, sample.T.expand(4, -1, -1))  # (4, p, 7)
        F = F.to(torch.float64)
        e1 = last_right_singular_vector(F.reshape(3, 3, -1).transpose(0, 1).contiguous())
        triplets = points[:, :, torch.tensor(self.TRIPLETS, device=points.device)].permute(0, 3, 1, 2)  # (4, 3, p, 5)
        count = len(self.TRIPLETS)
        H, valid = plane_homography(F[..., None].expand(-1, -1, count), e1[..., None].expand(-1, -1, count), triplets)
        near = transfer_squared(H, points) <= _limit(problem)
        members = torch.where(valid, near.sum(-1), 0)
        most = torch.sort(members, dim=1, descending=True, stable=True)
        return H.gather(2, most.indices[:, :1].expand(9, -1, -1))[..., 0], most.values[:, 0] >= self.ON_PLANE


def _limit(problem: Problem) -> Float[Tensor, "p 1 1"]:
    """The squared threshold of a plane in normalised units."""
    return (PLANE_THRESHOLD / problem.unit).square()[:, None, None]


def _fitted(H: Float[Tensor, "9 p"], problem: Problem) -> Float[Tensor, "9 p"]:
    """Homographies fitted to the matches near them, as long as these become more."""

    def near(H: Tensor) -> Tensor:
        return (transfer_squared(H[..., None], problem.points) <= _limit(problem))[:, 0] & problem.live

    inside = near(H)
    for _ in range(FITS):
        fit, determined = least_squares_homography(problem.points, inside.to(torch.float64))
        fit_inside = near(fit)
        better = determined & (fit_inside.sum(-1) > inside.sum(-1))
        H, inside = torch.where(better, fit, H), torch.where(better[:, None], fit_inside, inside)
    return H


def _parallax(
    H: Float[Tensor, "9 p"], problem: Problem, score: Score, turn: int
) -> tuple[Float[Tensor, "9 p kept"], Float[Tensor, "p kept"]]:
    """The best fundamental matrices of a homography and two matches off its plane, float32, and their scores.

    turn: makes the draws others than those of another turn.
    """
    near = (transfer_squared(H[..., None], problem.points) <= _limit(problem))[:, 0]
    weight = torch.where(near, 0, PriorWeighted().weight(problem))
    index = _draw(weight, problem, Stream.PARALLAX, turn * PARALLAX_DRAWS, PARALLAX_DRAWS, 2)
    points = torch.stack([problem.points.gather(2, i.expand(4, -1, -1)) for i in index], 1)
    F, valid = plane_and_parallax(H[..., None].expand(-1, -1, PARALLAX_DRAWS), points)
    models = F.to(torch.float32)
    scores = score_models(score, models, problem, problem.points.to(torch.float32))
    scores = scores.masked_fill(~valid | ((weight > 0).sum(-1) < 2)[:, None], -torch.inf)
    top, order = torch.sort(scores, dim=1, descending=True, stable=True)
    return models.gather(2, order[:, :KEPT].expand(9, -1, -1)), top[:, :KEPT]


def _draw(
    weight: Int[Tensor, "p n"], problem: Problem, stream: Stream, first: int, count: int, size: int
) -> Int[Tensor, "size p count"]:
    """`count` samples of `size` matches in proportion to their weights, with replacement."""
    bits = random.bits(problem.seed, problem.key, stream, first, count, size).flatten(1)
    table = weight.cumsum(-1)
    position = ((bits >> 31) * table[:, -1:]) >> 32
    index = torch.searchsorted(table, position, right=True).clamp_max_(weight.shape[1] - 1)
    return index.reshape(len(index), count, size).permute(2, 0, 1)


DEGENERACIES: dict[str, Callable[[Score], Degensac]] = {"degensac": Degensac}
