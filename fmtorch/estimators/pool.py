"""From a round's hypotheses to the pool: preselection, scores; and the matches near the models of a pool."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.core import random
from fmtorch.core.random import Stream
from fmtorch.estimators.models import Models
from fmtorch.estimators.options import Preselect
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.scores import Score, score_models
from fmtorch.geometry.residuals import sampson_squared


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
            few = self._first_look(pairs, self.preselect.matches)
            if few is not None:
                score = score_models(self.first_look, models.F, few, models.valid)
                order = torch.sort(score, dim=1, descending=True, stable=True).indices[:, : self.preselect.survivors]
                models = models.take(torch.sort(order, dim=1).values)  # the order of the draws, which breaks ties
        score = score_models(self.score, models.F, pairs, models.valid)
        return dataclasses.replace(models, score=score)

    def _first_look(self, pairs: NormalizedPairs, matches: int) -> NormalizedPairs | None:
        """The pairs with the matches of the first look. None where there are not many more.

        A score that weighs matches by their prior gets such as are drawn by it, each of which counts as one.
        """
        if pairs.mask.shape[1] < 2 * matches:
            return None
        by_prior = self.score.prior_weighted and pairs.prior is not None
        order = by_priority if by_prior else in_random_order
        index = pairs.once(f"{matches} matches of a first look", lambda: order(pairs)[:, :matches].contiguous())
        few = pairs.take(index, pairs.mask)
        if few.prior is None or not by_prior:
            return few
        return dataclasses.replace(few, prior=(few.prior > 0).to(torch.float64))


def in_random_order(pairs: NormalizedPairs) -> Int[Tensor, "p n"]:
    """The matches in an order that the pair's key decides, empty slots last."""
    return shuffled(pairs, Stream.PRESELECTION, pairs.mask)


def by_priority(pairs: NormalizedPairs) -> Int[Tensor, "p n"]:
    """The matches by falling prior / u, u random and uniform, empty slots last.

    The first ones are drawn by their prior and without replacement, and each stands for as much of it: priority
    sampling (Duffield, Lund & Thorup, J. ACM 2007).
    """
    assert pairs.prior is not None
    bits = random.bits(pairs.seed, pairs.key, Stream.PRESELECTION, 0, pairs.mask.shape[1], 1)[..., 0]
    priority = torch.where(pairs.mask, pairs.prior.detach() / (bits.to(torch.float64) + 1), -1)
    return torch.sort(priority, dim=1, descending=True, stable=True).indices


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
