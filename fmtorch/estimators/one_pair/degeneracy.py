"""`degeneracy` on the arrays of one pair: the same planes, and the same draws off them."""

from __future__ import annotations

import numpy as np

from fmtorch.core.random import Stream, mixed_seed
from fmtorch.estimators import degeneracy
from fmtorch.estimators.degeneracy import FITS, KEPT, PARALLAX_DRAWS
from fmtorch.estimators.degeneracy_kernels import fit_plane, parallax, plane_of_sample
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.estimators.one_pair.sampling import PriorWeighted
from fmtorch.estimators.one_pair.scores import Score
from fmtorch.estimators.sampling import PriorWeighted as TensorPriorWeighted


class Degensac:
    """As `degeneracy.Degensac`. score: of the engine."""

    def __init__(self, part: degeneracy.Degensac, score: Score) -> None:
        self.part, self.score = part, score
        self.triplets = np.array(part.TRIPLETS)
        self.draws_of = PriorWeighted(TensorPriorWeighted())

    def __call__(self, models: Models, best: float, pair: OnePair) -> Models:
        """As `degeneracy.Degensac`."""
        assert models.which is not None
        assert models.score is not None
        if not len(models.score):  # no sample gave a model
            return models
        first = int(np.argmax(models.score))
        if not models.score[first] > best:
            return models
        which = int(models.which[first])
        H, on_plane = self.plane(models.F[which].astype(np.float64), models.sample_of(int(models.draw[which])), pair)
        if on_plane < self.part.ON_PLANE:
            return models
        F, score = self.completed(H, pair, models.start)
        more = len(score)
        return models._replace(
            F=np.concatenate([models.F, F]),
            draw=np.concatenate([models.draw, np.full(more, models.draw[which])]),
            which=np.concatenate([models.which, len(models.F) + np.arange(more)]),
            score=np.concatenate([models.score, score]),
        )

    def plane(self, F: Array, sample: Array, pair: OnePair) -> tuple[Array, int]:
        """The compatible homography (9,) with most matches of the sample (7,), and how many these are."""
        H = np.empty(9)
        return H, plane_of_sample(F, np.ascontiguousarray(pair.points[:, sample]), self.triplets, _limit(pair), H)

    def completed(self, H: Array, pair: OnePair, turn: int) -> tuple[Array, Array]:
        """The best models (m, 9) of the plane and two matches off it, float32, and their scores (m,)."""
        near = np.empty(pair.count, np.bool_)
        fit_plane(H, pair.points, _limit(pair), FITS, near)
        weight = np.where(near, 0, self.draws_of.weight(pair))
        F = np.empty((PARALLAX_DRAWS, 9), np.float32)
        if np.count_nonzero(weight) < 2:
            return F[:0], np.empty(0)
        start, seed = 2 * turn * PARALLAX_DRAWS, mixed_seed(pair.seed, Stream.PARALLAX)
        F = F[: parallax(H, pair.points, np.cumsum(weight), seed, pair.key, start, F)]
        score = self.score(F, np.arange(len(F)), pair)
        kept = np.argsort(-score, kind="stable")[:KEPT]
        return F[kept], score[kept]


def _limit(pair: OnePair) -> float:
    """The squared threshold of a plane in normalised units."""
    return squared(degeneracy.PLANE_THRESHOLD_PX / pair.pixels_per_unit)
