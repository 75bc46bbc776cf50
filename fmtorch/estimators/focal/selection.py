"""The choice among candidates refined with the prior, and whether it may be trusted."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.focal.cameras import TwoCameras
from fmtorch.estimators.focal.posterior import refine_with_prior
from fmtorch.estimators.models import Pool
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.refinement import AsFound, PoolRefinement
from fmtorch.estimators.saturated_gains import SaturatedGains
from fmtorch.estimators.scores import score_models
from fmtorch.estimators.selection import Selection
from fmtorch.geometry.arithmetic import component_sum

# Share of the best gain without prior that gain minus prior cost must reach; chosen on castle-P19, fox, crops of them.
MIN_GAIN_SHARE = 0.85
# A good candidate has RIVAL_GAIN_SHARE of the best gain; it is another model than the best where 1 - |cosine| of the
# two as vectors is above SAME_MODEL, or SAME_CAMERAS for candidates of plausible cameras.
RIVAL_GAIN_SHARE, SAME_MODEL, SAME_CAMERAS = 0.85, 1e-3, 1e-2


@dataclasses.dataclass(frozen=True, eq=False)
class Candidates:
    """Models of greatest posterior nearby, what that is (minus infinity for none), and their cameras."""

    F: Float[Tensor, "9 p k"]
    posterior: Float[Tensor, "p k"]
    cameras: TwoCameras

    def only(self, rows: Sequence[int]) -> Candidates:
        """Those of the selected pairs."""
        index = torch.tensor(rows, device=self.posterior.device)
        return Candidates(self.F[:, index], self.posterior[index], self.cameras[index])

    def joined(self, other: Candidates) -> Candidates:
        """The candidates of both."""
        F, posterior = torch.cat([self.F, other.F], -1), torch.cat([self.posterior, other.posterior], -1)
        return Candidates(F, posterior, self.cameras.joined(other.cameras))

    def best(self) -> tuple[Float[Tensor, "9 p"], TwoCameras, Float[Tensor, " p"]]:
        """The candidate of the greatest posterior, the first of several, its cameras, and that posterior."""
        top, order = torch.sort(self.posterior, dim=1, descending=True, stable=True)
        first = order[:, :1]

        def taken(x: Tensor) -> Tensor:
            return x.gather(-1, first.expand(*x.shape[:-2], -1, -1))[..., 0]

        return taken(self.F), TwoCameras(taken(self.cameras.axes), taken(self.cameras.focal)), top[:, 0]

    def best_alone(self) -> Candidates:
        """The candidate of the greatest posterior alone."""
        F, cameras, posterior = self.best()
        return Candidates(
            F[..., None], posterior[:, None], TwoCameras(cameras.axes[..., None], cameras.focal[..., None])
        )

    def replaced(self, rows: Sequence[int], other: Candidates) -> Candidates:
        """With other candidates, as many, for these pairs."""
        index = torch.tensor(rows, device=self.posterior.device)
        F, posterior = self.F.index_copy(1, index, other.F), self.posterior.index_copy(0, index, other.posterior)
        return Candidates(F, posterior, self.cameras.replaced(index, other.cameras))

    def selection(self, draws: Int[Tensor, " p"]) -> Selection:
        """The best candidates, from so many minimal samples."""
        F, cameras, posterior = self.best()
        return Selection(F, cameras, torch.isfinite(posterior), draws)

    def same_best(self, other: Candidates) -> list[bool]:
        """Whether the best candidates of both are one and the same model."""
        (mine, _, posterior), (theirs, _, their_posterior) = self.best(), other.best()
        found = torch.isfinite(posterior) & torch.isfinite(their_posterior)
        same: list[bool] = (found & (1 - component_sum(mine * theirs).abs() <= SAME_CAMERAS)).tolist()
        return same

    def unambiguous(self) -> list[bool]:
        """Whether all good candidates are one and the same model."""
        posterior, order = torch.sort(self.posterior, dim=1, descending=True, stable=True)
        F = self.F.gather(2, order.expand(9, -1, -1))
        one: list[bool] = (torch.isfinite(posterior[:, 0]) & ~_rivals(F, posterior, SAME_CAMERAS)).tolist()
        return one


class FocalSelection:
    """Refines candidates as maxima a posteriori over E and two focal lengths and selects among these.

    The estimate is the candidate with the largest gain (`SaturatedGains`), times the share of its support in front of
    both cameras, minus prior cost, if that reaches MIN_GAIN_SHARE of the largest gain without prior; otherwise the
    model of the latter. gain: the score of models. iterations: Levenberg-Marquardt steps. candidates: refined, those of
    the largest gain, besides those that were made with focal lengths.
    """

    def __init__(self, gain: SaturatedGains, iterations: int = 12, candidates: int = 12) -> None:
        self.gain, self.iterations, self.candidates = gain, iterations, candidates

    def of_pool(self, pool: Pool, pairs: NormalizedPairs, refinement: PoolRefinement | AsFound) -> Candidates:
        """The models of a pool refined on the matches near them, as `refinement` says which these are."""
        return self.refined(pool.models, pool.valid, pairs, refinement.near(pool, pairs))

    def refined(
        self, F: Float[Tensor, "9 p k"], valid: Bool[Tensor, "p k"], pairs: NormalizedPairs, near: NormalizedPairs
    ) -> Candidates:
        """The models refined on the matches `near` them, with their posteriors."""
        models, cost, front, cameras = refine_with_prior(F, near, self.iterations)
        posterior = score_models(self.gain, models, pairs) * front - cost
        return Candidates(models, torch.where(valid, posterior.nan_to_num(nan=-torch.inf), -torch.inf), cameras)

    def select(self, pool: Pool, pairs: NormalizedPairs, others: Candidates | None) -> Selection:
        """The selection of a refined pool, or of other candidates."""
        assert pool.near is not None
        F, cameras = self(pool.models, pool.valid, pairs, pool.near, others)
        return Selection(F, cameras, pool.valid.any(1), pool.draws)

    def __call__(
        self,
        F: Float[Tensor, "9 p k"],
        valid: Bool[Tensor, "p k"],
        pairs: NormalizedPairs,
        near: NormalizedPairs,
        others: Candidates | None = None,
    ) -> tuple[Float[Tensor, "9 p"], TwoCameras]:
        """The selected models and the cameras that were assumed.

        F, valid: models made without assumptions, float64, of unit norm. others: candidates made with focal lengths;
        without these the prior is asked only where good models differ.
        """
        gain = torch.where(valid, score_models(self.gain, F, pairs), -torch.inf)
        gain, order = torch.sort(gain, dim=1, descending=True, stable=True)
        F = F.gather(2, order.expand(9, -1, -1))
        best, cameras = F[..., 0], TwoCameras.none(F[..., 0])
        asked = _rivals(F, gain, SAME_MODEL) if others is None else torch.ones_like(valid[:, 0])
        (rows,) = asked.nonzero(as_tuple=True)
        if not len(rows):
            return best, cameras
        tried, worth = F[:, rows, : self.candidates], torch.isfinite(gain[rows, : self.candidates])
        candidates = self.refined(tried, worth, pairs.only(rows), near.only(rows))
        if others is not None:
            candidates = candidates.joined(others)
        models, their_cameras, posterior = candidates.best()
        (plausible,) = (posterior >= MIN_GAIN_SHARE * gain[rows, 0]).nonzero(as_tuple=True)
        best = best.index_copy(1, rows[plausible], models[:, plausible])
        return best, cameras.replaced(rows[plausible], their_cameras[plausible])


def _rivals(F: Float[Tensor, "9 p k"], gain: Float[Tensor, "p k"], same: float) -> Bool[Tensor, " p"]:
    """Whether a good candidate is another model than the best, which comes first."""
    apart = 1 - component_sum(F * F[..., :1]).abs()
    return ((gain >= RIVAL_GAIN_SHARE * gain[:, :1]) & ~(apart <= same)).any(1)
