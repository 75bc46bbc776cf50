"""From a round's hypotheses to the pool: preselection, scores; and the matches near the models of a pool."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch import random
from fmtorch.estimators.models import Models
from fmtorch.estimators.options import Preselect
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.scores import Score, score_models
from fmtorch.geometry.residuals import sampson_squared
from fmtorch.random import Stream


class Verifier:
    """Scores a round's models, the weaker ones dropped after a look at few matches.

    score: by which models are compared. preselect: the matches of the first look and the models that pass it; None:
    every model is scored on every match.
    """

    def __init__(self, score: Score, preselect: Preselect | None) -> None:
        self.score, self.preselect = score, preselect
        self.first_look: Score = getattr(score, "first_look", score)

    def __call__(self, models: Models, pairs: NormalizedPairs) -> Models:
        """The models that are left, in the order of their draws, with their scores."""
        models = in_front(models)
        if self.preselect is not None and models.F.shape[2] > self.preselect.survivors:
            subset = self._subset(pairs, self.preselect.matches)
            if subset is not None:
                score = score_models(self.first_look, models.F, pairs, subset, models.valid)
                order = torch.sort(score, dim=1, descending=True, stable=True).indices[:, : self.preselect.survivors]
                models = models.take(torch.sort(order, dim=1).values)  # the order of the draws, which breaks ties
        score = score_models(self.score, models.F, pairs, valid=models.valid)
        return dataclasses.replace(models, score=score)

    @staticmethod
    def _subset(pairs: NormalizedPairs, matches: int) -> Int[Tensor, "p k"] | None:
        """The matches of the first look: those with the smallest hash. None where there are not many more."""
        n = pairs.mask.shape[1]
        if n < 2 * matches:
            return None
        return pairs.once(
            f"{matches} matches of a first look",
            lambda: shuffled(pairs, Stream.PRESELECTION, pairs.mask)[:, :matches].contiguous(),
        )


def in_front(models: Models) -> Models:
    """Valid models moved to the front in their order; slots that are invalid for every pair are cut off."""
    longest = int(models.valid.sum(1).max())
    return models.take(torch.sort((~models.valid).to(torch.uint8), dim=1, stable=True).indices[:, :longest])


def shuffled(pairs: NormalizedPairs, stream: Stream, wanted: Tensor) -> Int[Tensor, "p n"]:
    """The wanted matches in an order that the pair's key decides, then the others."""
    order = random.bits(pairs.seed, pairs.key, stream, 0, wanted.shape[1], 1)[..., 0]
    order = torch.where(wanted, order, torch.iinfo(torch.int64).max)
    return torch.sort(order, dim=1, stable=True).indices


def near_models(F: Float[Tensor, "9 p k"], pairs: NormalizedPairs, radius: float, most: int | None) -> NormalizedPairs:
    """The same pairs with at most so many of the matches within the radius, in pixels, of one of the models.

    Which of them, the pair's key decides. most: None for all matches, near or not.
    """
    if most is None:
        return pairs
    r2 = sampson_squared(F, pairs.points32).nan_to_num_(torch.inf)
    r2 = r2.masked_fill_((F == 0).all(0)[..., None], torch.inf).amin(1)  # nothing is near a place that holds no model
    near = pairs.mask & (r2 * pairs.pixels_per_unit.square()[:, None].to(r2.dtype) <= radius**2)
    longest = min(most, max(int(near.sum(1).max()), 1))
    return pairs.take(shuffled(pairs, Stream.REFINEMENT, near)[:, :longest], near)
