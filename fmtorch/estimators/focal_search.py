"""The search among plausible cameras: rounds of samples of five, each refined with the prior on focal lengths."""

import dataclasses
import math

import numpy as np

from fmtorch.estimators.models.posterior import Cameras, parallax
from fmtorch.estimators.models.with_focals import FundamentalWithFocals, Refined
from fmtorch.estimators.pair import Pair
from fmtorch.estimators.preselection import Count, NonNegative
from fmtorch.estimators.refinement import BestScore, Candidates, Fit, Refinement, Selection, scores_of
from fmtorch.estimators.scores import Score
from fmtorch.estimators.search import Search, Stop
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, kernel

# Share of the best gain without prior that gain minus prior cost must reach; chosen on castle-P19, fox, crops of them.
MIN_GAIN_SHARE = 0.85
# A good candidate has RIVAL_GAIN_SHARE of the best gain; it is another model than the best where 1 - |cosine| of the
# two as vectors is above SAME_MODEL, or SAME_CAMERAS for candidates of plausible cameras.
RIVAL_GAIN_SHARE, SAME_MODEL, SAME_CAMERAS = 0.85, 1e-3, 1e-2


# Where nine tenths of the inliers have a parallax below STILL noises, a wrong match beside its epipolar line has far
# more, and outweighs them all in the direction of translation. Chosen on simulated scenes.
STILL, OUTLYING = 100.0, 2.0


@dataclasses.dataclass(frozen=True)
class Focal:
    """The prior on focal lengths, for whole photographs of known size.

    samples: of five matches, with focal lengths drawn from the prior; 0: none, the prior only selects. rounds,
    min_rounds: of so many samples, at most and at least; in between a pair goes on while its good candidates differ or
    the stopping rule asks for more. confirmations: rounds that find the best candidate of those before them again,
    after which it does not matter that others differ. pool: the best models of a round, which are refined with the
    prior. candidates: models of the other search that are, too. iterations: steps of that refinement. sqrt_prior:
    whether the root of P(inlier) stands for it in samples and scores, but not in fits."""

    samples: NonNegative = 250
    rounds: Count = 1
    min_rounds: Count = 1
    confirmations: Count = 1
    pool: Count = 12
    candidates: Count = 12
    iterations: NonNegative = 12
    sqrt_prior: bool = False

    def __post_init__(self) -> None:
        if self.min_rounds > self.rounds:
            raise ValueError(f"focal.min_rounds is {self.min_rounds}; it must be at most focal.rounds, {self.rounds}")


class PlausibleCandidates:
    """Models F (k, 9) of greatest posterior nearby, what that is (k,), minus infinity for none, and their cameras.
    refined: these models with cost of the prior and share in front of the cameras. best: the candidate of the greatest
    posterior, the first of several. valid: whether there is one."""

    def __init__(self, refined: Refined, posterior: Array, cameras: Cameras) -> None:
        self.refined, self.posterior, self.cameras = refined, posterior, cameras
        self.F, self.best = refined.models, int(posterior.argmax())
        self.valid = math.isfinite(posterior[self.best])

    def joined(self, other: "PlausibleCandidates") -> "PlausibleCandidates":
        """The candidates of both."""
        refined = Refined(*map(np.concatenate, zip(self.refined, other.refined, strict=True)))
        posterior = np.concatenate([self.posterior, other.posterior])
        return PlausibleCandidates(refined, posterior, self.cameras.joined(other.cameras))

    def best_alone(self) -> "PlausibleCandidates":
        """The candidate of the greatest posterior alone."""
        k = slice(self.best, self.best + 1)
        refined = Refined(*(values[k] for values in self.refined))
        return PlausibleCandidates(refined, self.posterior[k], self.cameras.of(self.best))

    def judged(self, score: Score, pair: Pair) -> "PlausibleCandidates":
        """The same with the posterior by a score."""
        gain, valid, posterior = scores_of(score, self.F, pair), np.isfinite(self.posterior), np.empty(len(self.F))
        posteriors(gain, self.refined.share, self.refined.cost, valid, posterior)
        return PlausibleCandidates(self.refined, posterior, self.cameras)

    @property
    def selection(self) -> Selection:
        """The best one."""
        return Selection(self.F[self.best], self.valid, self.cameras.of(self.best) if self.valid else None)

    def confirmed(self, other: "PlausibleCandidates") -> bool:
        """Whether the best of both are one model."""
        return self.valid and other.valid and same_model(self.F[self.best], other.F[other.best], SAME_CAMERAS)

    @property
    def unique_optimum(self) -> bool:
        """Whether all good candidates are one model."""
        return self.valid and not distinct_models(self.F, self.posterior, self.best, RIVAL_GAIN_SHARE, SAME_CAMERAS)


@dataclasses.dataclass(frozen=True)
class FocalSearch:
    """The prior on focal lengths in a search. choice: by which candidates are compared. search: of one round; None: the
    prior only selects. stop: the stopping rule for these samples; None: all rounds are made, and never suffice."""

    options: Focal
    family: FundamentalWithFocals
    choice: BestScore
    refinement: Refinement
    search: Search | None
    stop: Stop | None

    def __call__(self, pair: Pair) -> tuple[PlausibleCandidates, bool, int]:
        """All candidates of the rounds, whether the best of them is the estimate, and the samples drawn.
        Rounds are made until good candidates are one model, or enough rounds have confirmed the best one, and the
        stopping rule is content. The best one is the estimate if that rule is content and the images have one size, or
        if anything is known of the cameras."""
        options, confirmations, rounds = self.options, 0, 1
        candidates, draws = self.round(pair, 0)
        while True:
            best = candidates.F[candidates.best]
            stop = self.stop is not None and candidates.valid and self.stop(best, draws, pair, self.family.size)
            agreed = candidates.unique_optimum or confirmations >= options.confirmations
            if rounds >= options.rounds or (rounds >= options.min_rounds and agreed and stop):
                break
            new, draws = self.round(pair, rounds)
            confirmations += candidates.confirmed(new)
            candidates, rounds = candidates.joined(new), rounds + 1
        if candidates.valid and self.choice.at_noise is not None:
            candidates = candidates.judged(self.choice.of_pair(candidates.F[candidates.best], pair), pair)
        return candidates, pair.calibration is not None or (pair.same_size and stop), draws

    def round(self, pair: Pair, turn: int) -> tuple[PlausibleCandidates, int]:
        """The candidates of a round, and the samples drawn until then."""
        assert self.search is not None
        pool = self.search(pair, turn * self.options.samples)
        new = self.refined(pool.models, np.full(len(pool.models), pool.filled > 0), self.refinement.near(pool, pair))
        return new.judged(self.choice.score, pair), pool.samples

    def refined(self, F: Array, valid: Array, near: Pair) -> PlausibleCandidates:
        """Candidates near models (k, 9), refined on some matches and not judged yet."""
        cameras, refined = self.family.refine(F, near, self.options.iterations)
        return PlausibleCandidates(refined, np.where(valid, 0.0, -np.inf), cameras)

    def select(self, free: Candidates, pair: Pair, plausible: PlausibleCandidates | None) -> Selection:
        """One of the models searched without assumptions, or of plausible cameras near them, or of those before.
        Plausible cameras are taken where their gain minus the cost of the prior is nearly the best gain without one;
        they are tried where good models differ or some were there before, and taken where cameras are known."""
        known, before = pair.calibration is not None, None if plausible is None else plausible.best_alone()
        score = self.choice.of_pair(self.choice.first(free, pair).F if before is None else before.F[0], pair)
        gain = np.where(free.valid, scores_of(score, free.F, pair), -np.inf)
        order = np.argsort(-gain, kind="stable")
        models, gain = free.F[order], gain[order]
        selection = Selection(models[0], free.valid or (before is not None and before.valid))
        if before is None and not known and not distinct_models(models, gain, 0, RIVAL_GAIN_SHARE, SAME_MODEL):
            return selection
        tried = slice(self.options.candidates)
        candidates = self.refined(models[tried], np.isfinite(gain[tried]), free.near)
        candidates = (candidates if before is None else candidates.joined(before)).judged(score, pair)
        believed = candidates.posterior[candidates.best] >= MIN_GAIN_SHARE * gain[0]
        if not (believed or (known and candidates.valid)):
            return selection
        return selection._replace(F=candidates.F[candidates.best], cameras=candidates.cameras.of(candidates.best))


def outlying(fit: Fit | None, inliers: Array | None, pair: Pair) -> Array | None:
    """The matches (n,) of calibrated cameras at little parallax that have OUTLYING times that of nine tenths of the
    inliers (n,), None where no inlier has."""
    if fit is None or fit.cameras is None or inliers is None or not inliers.any():
        return None
    if pair.calibration is None or not pair.calibration.exact:
        return None
    both = parallax(fit.cameras, pair)
    both = both if pair.stretch is None else both / pair.stretch
    usual = np.sort(both[:, inliers], axis=1)[:, np.count_nonzero(inliers) * 9 // 10]
    nearer = int(usual.argmin())
    beyond: Array = both[nearer] > OUTLYING * usual[nearer]
    return beyond if usual[nearer] * math.sqrt(fit.precision) < STILL and (beyond & inliers).any() else None


@kernel(holds_gil=True)
def posteriors(gain: F8x1, share: F8x1, cost: F8x1, valid: B1x1, out: F8x1) -> None:
    """Gain times share in front of the cameras minus cost of the prior -> out (k,), minus infinity of none."""
    for k in range(len(out)):
        posterior = gain[k] * share[k] - cost[k]
        out[k] = posterior if valid[k] and not math.isnan(posterior) else -math.inf


@kernel(holds_gil=True)
def distinct_models(F: F8x2, gain: F8x1, best: int, share: float, tolerance: float) -> bool:
    """Whether a model (k, 9) that has a share of the gain (k,) of the best is another one than it."""
    distinct = False
    for k in range(len(F)):
        distinct |= gain[k] >= share * gain[best] and not same_model(F[k], F[best], tolerance)
    return distinct


@kernel(holds_gil=True)
def same_model(F: F8x1, G: F8x1, tolerance: float) -> bool:
    """Whether two models (9,) of unit norm are one, up to the tolerance of 1 - |cosine|."""
    cosine = 0.0
    for i in range(9):
        cosine += F[i] * G[i]
    return 1 - abs(cosine) <= tolerance
