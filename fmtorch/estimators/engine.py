"""Hypothesise and verify: one loop whose parts make RANSAC, MSAC, LMedS and their descendants.

sampler x minimal solver x score x local optimisation x stopping rule x final fit; a config names the parts.
The search runs without gradients in float32; the final fit is attached to the caller's graph and runs in float64.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch import random
from fmtorch.estimators.batching import solve_all
from fmtorch.estimators.calibrated import SAMPLE as FIVE
from fmtorch.estimators.calibrated import calibrated_hypotheses
from fmtorch.estimators.choice import Chosen, TwoCameras, best_of
from fmtorch.estimators.degeneracy import DEGENERACIES, Degensac
from fmtorch.estimators.final_fits import FINAL_FITS
from fmtorch.estimators.focal import FocalPrior, Refined
from fmtorch.estimators.local_optimization import LOCAL_OPTIMIZATIONS
from fmtorch.estimators.parts import CHOICES, INLIER_RULES, SAMPLERS, SCORES, SOLVERS, Refinement, part
from fmtorch.estimators.problem import Problem
from fmtorch.estimators.sampling import PriorWeighted
from fmtorch.estimators.scoring import SaturatedGains, score_models
from fmtorch.geometry.residuals import sampson_squared
from fmtorch.random import Stream
from fmtorch.types import Correspondences, Estimate

CPU_SAMPLES = 1 << 14  # minimal samples that are solved together: bounds memory, changes no result
GPU_SAMPLES = 1 << 21
REACH = 4.0  # refinement thresholds: a match farther from all models of the pool is not looked at again
CALIBRATED_ROUND = 500  # samples of five matches of a pair at a time
CPU_CALIBRATED, GPU_CALIBRATED = 1 << 10, 1 << 19  # of all pairs: stays in the L2 cache; bounds memory
UNSTOPPED_ROUND = 2000  # samples of a round where nobody looks in between: few operations on many numbers are faster


@dataclasses.dataclass
class _Search:
    """What is known of P pairs: the best models so far, their scores (descending), and the draws made."""

    F: Float[Tensor, "9 p k"]
    score: Float[Tensor, "p k"]
    draws: Int[Tensor, " p"]

    @staticmethod
    def empty(p: int, k: int, device: torch.device) -> _Search:
        """Nothing found yet."""
        return _Search(
            torch.zeros(9, p, k, device=device),
            torch.full((p, k), -torch.inf, device=device),
            torch.zeros(p, dtype=torch.int64, device=device),
        )


class HypothesizeAndVerify:
    """A robust estimator of fundamental matrices, batched over pairs.

    solver: minimal solver, `seven_point` or `eight_point`.
    sampler: `uniform` or `prior`. score: a name of `parts.SCORES`.
    threshold: Sampson distance in pixels up to which a match supports a model (unused by `median`).
    hypotheses: minimal samples drawn at most. round: samples between two looks at the stopping rule; without one,
    rounds of `UNSTOPPED_ROUND` at least.
    confidence: stop once an all-inlier sample was drawn with this probability; None: never before `hypotheses`.
    preselect: models are first scored on this many matches, chosen by the pair's key; 0: always on all.
    survivors: models of a round that pass the preselection.
    degeneracy: `degensac` completes a best model whose sample lies on a plane by plane and parallax, null: no check.
    calibrated: samples of five matches with focal lengths drawn from their prior, 0: none; where the image sizes are
    known and the choice is a `focal` one. The best calibrated_pool of their models are refined with the prior. They are
    all that is asked of a pair whose images have one size, or whose good candidates agree, if the stopping rule is
    content with them; other pairs are searched without assumptions, too, and both kinds of candidates compared.
    pool: the best models that are kept to the end. local_optimization: of the pool, `graph_cut` or null: none.
    refine: robust kernel of the Levenberg-Marquardt refinement of the pool (`truncated`, `cauchy`, ...), null: none;
    refine_threshold: its scale, Sampson distance in pixels; refine_iterations: its steps. choice: by which score the
    estimate is chosen from the refined pool, `score` (the search's own), `saturated` (gains saturate in each cell of a
    grid) or `focal` (the same, with a prior on the focal length and without matches behind a camera: for whole
    photographs, not crops; `saturated` where the image sizes are unknown; `focal_any_side`: matches behind a camera
    count); choice_threshold: of the last two, Sampson distance in pixels, null: the score's;
    choice_pool, choice_iterations: candidates and steps of the refinement that `focal` makes.
    refine_matches: refinements look at so many matches at most, drawn by the pair's key from those within REACH
    refine_thresholds of a model of the pool; null: at all.
    inliers: `threshold`, `lmeds` (2.5 robust standard deviations) or `median` (the better half).
    inlier_threshold: of the inliers reported, Sampson distance in pixels; null: the score's threshold.
    final: `least_squares` (8-point on the inliers, weighted by prior and noise where there is a prior),
    `unweighted_least_squares` (8-point on the inliers, all alike), `gauss_newton` (one attached step), `adaptive`
    (refined at the scale of the pair's own noise, with the prior on the focal lengths where the choice assumed one and
    the matches do not contradict it; with the gradients of the optimum) or `none`.
    refit_inliers: recompute the inliers after the final fit.

    Memory: for a batch of pairs of N matches, the points (48 N bytes a pair), the samples of 2^14 draws (about 40 MB),
    2^10 samples of five (about 20 MB) and eight buffers of one scoring tile (256 KB each); on a GPU 2^21 draws, 2^19
    samples of five and 256 MB a buffer.
    """

    def __init__(
        self,
        *,
        solver: str = "seven_point",
        sampler: str = "uniform",
        score: str = "msac",
        threshold: float = 1.0,
        hypotheses: int = 2000,
        round: int = 500,
        confidence: float | None = 0.9999,
        preselect: int = 128,
        survivors: int = 256,
        degeneracy: str | None = None,
        pool: int = 1,
        calibrated: int = 0,
        calibrated_pool: int = 12,
        local_optimization: str | None = None,
        refine: str | None = None,
        refine_threshold: float = 1.0,
        refine_iterations: int = 5,
        refine_matches: int | None = None,
        choice: str = "score",
        choice_threshold: float | None = None,
        choice_pool: int = 12,
        choice_iterations: int = 12,
        inliers: str = "threshold",
        inlier_threshold: float | None = None,
        final: str = "least_squares",
        refit_inliers: bool = True,
    ) -> None:
        if hypotheses < 1 or round < 1:
            raise ValueError(f"hypotheses={hypotheses}, round={round}: both must be at least 1")
        if confidence is not None and not 0 < confidence < 1:
            raise ValueError(f"confidence is {confidence}; it is a probability between 0 and 1, or null")
        self.solver = part("solver", solver, SOLVERS)()
        self.sampler = part("sampler", sampler, SAMPLERS)()
        self.score = part("score", score, SCORES)(threshold)
        self.coarse = self.score.unsaturated if isinstance(self.score, SaturatedGains) else self.score
        self.inlier_threshold = threshold if inlier_threshold is None else inlier_threshold
        self.hypotheses, self.confidence = hypotheses, confidence
        self.round = round if confidence is not None else max(round, UNSTOPPED_ROUND)
        self.preselect, self.survivors = preselect, survivors
        self.degeneracy = None if degeneracy is None else part("degeneracy", degeneracy, DEGENERACIES)(self.score)
        if self.degeneracy is not None and self.solver.size != Degensac.SAMPLE:
            raise ValueError(f"degeneracy={degeneracy} needs solver=seven_point; solver is {solver!r}")
        self.pool = pool
        self.calibrated, self.calibrated_pool = calibrated, calibrated_pool
        self.local_optimization = None
        if local_optimization is not None:
            optimization = part("local_optimization", local_optimization, LOCAL_OPTIMIZATIONS)
            self.local_optimization = optimization(threshold, self.score)
        self.refinement = None if refine is None else Refinement(refine, refine_threshold, refine_iterations)
        self.reach, self.refine_matches = REACH * refine_threshold, refine_matches
        self.choice = (
            None
            if choice == "score"
            else part("choice", choice, CHOICES)(choice_threshold or threshold, choice_iterations, choice_pool)
        )
        self.inlier_rule = part("inliers", inliers, INLIER_RULES)(self.inlier_threshold)
        self.final = part("final", final, FINAL_FITS)()
        self.refit_inliers = refit_inliers

    @property
    def uses_prior(self) -> bool:
        """Whether a prior makes a difference to the search."""
        return isinstance(self.sampler, PriorWeighted) or getattr(self.score, "prior_weighted", False)

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the fundamental matrices of a batch of pairs; a pair that cannot be solved is `ok=False`."""
        samples = GPU_SAMPLES if c.mask.is_cuda else CPU_SAMPLES
        pairs = samples // self.round
        return solve_all(c, seed, self.solver.size, self._solve, "every minimal sample was degenerate", pairs)

    def _solve(self, problem: Problem) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Search, then fit: F (p, 3, 3) in normalised units, inliers (p, n), found (p,), draws (p,)."""
        with torch.no_grad():
            chosen, found, draws = self._found(problem)
            best = chosen.F.T.reshape(-1, 3, 3)
            inliers = self.inlier_rule(best, problem)
        F = self.final(best, problem, inliers, chosen.cameras)
        if self.refit_inliers:
            with torch.no_grad():
                inliers = self.inlier_rule(F, problem)
        return F, inliers, found, draws

    def _found(self, problem: Problem) -> tuple[Chosen, Tensor, Tensor]:
        """The estimates before the final fit, whether there are any, and the draws made."""
        if (
            not (self.calibrated and isinstance(self.choice, FocalPrior))
            or problem.size0 is None
            or problem.size1 is None
        ):
            return self._searched(problem, None)
        F, alive = self._calibrated(problem)
        refined = self.choice.refined(F.to(torch.float64), alive, problem, self._near(F, problem))
        chosen, posterior = refined.best()
        found = torch.isfinite(posterior)
        draws = torch.full_like(problem.count, self.calibrated)
        one_camera = (problem.size0 == problem.size1).all(-1)
        settled = (one_camera | self.choice.settled(refined)) & self._enough(chosen.F, draws, problem, FIVE)
        (rest,) = (~settled).nonzero(as_tuple=True)
        if len(rest):
            other, other_found, other_draws = self._searched(problem.only(rest), refined[rest])
            chosen, found = chosen.replaced(rest, other), found.index_copy(0, rest, other_found | found[rest])
            draws = draws.index_add(0, rest, other_draws)
        return chosen, found, draws

    def _searched(self, problem: Problem, refined: Refined | None) -> tuple[Chosen, Tensor, Tensor]:
        """The same by search without assumptions; refined: candidates of plausible cameras."""
        search = self._search(problem)
        found = torch.isfinite(search.score).any(1)
        return self._chosen(search, problem, refined), found, search.draws

    def _chosen(self, search: _Search, problem: Problem, refined: Refined | None) -> Chosen:
        """The best of the pool, once optimised and refined, by the score of the choice; float64."""
        nothing = TwoCameras.none(problem)
        if self.local_optimization is None and self.refinement is None and self.choice is None:
            return Chosen(search.F[:, :, 0].to(torch.float64), nothing)
        F, alive = search.F.to(torch.float64), torch.isfinite(search.score)
        if self.local_optimization is not None:
            F = self.local_optimization(F, problem)
        near = self._near(search.F, problem)
        if self.refinement is not None:
            F = self.refinement(F, near)
        if isinstance(self.choice, FocalPrior):
            return self.choice(F, alive, problem, near, refined)
        if self.choice is not None:
            return self.choice(F, alive, problem, near)
        score = score_models(self.score, F.to(torch.float32), problem, problem.points.to(torch.float32))
        return Chosen(best_of(F, score, alive), nothing)

    def _calibrated(self, problem: Problem) -> tuple[Float[Tensor, "9 p k"], Bool[Tensor, "p k"]]:
        """The best models of cameras with plausible focal lengths, and which slots hold one; in tiles of pairs."""
        limit = GPU_CALIBRATED if problem.points.is_cuda else CPU_CALIBRATED
        everything = torch.arange(len(problem.pair), device=problem.points.device)
        tiles = torch.split(everything, max(1, limit // min(self.calibrated, CALIBRATED_ROUND)))
        states = [self._calibrated_search(problem.only(tile)) for tile in tiles]
        F, score = torch.cat([s.F for s in states], 1), torch.cat([s.score for s in states])
        return F, torch.isfinite(score)

    def _calibrated_search(self, problem: Problem) -> _Search:
        points = problem.points.to(torch.float32)
        everything = torch.arange(len(problem.pair), device=points.device)
        state = _Search.empty(len(problem.pair), self.calibrated_pool, points.device)
        table = self.sampler.table(problem, FIVE)
        subset = self._subset(problem)
        for start in range(0, self.calibrated, CALIBRATED_ROUND):
            count = min(CALIBRATED_ROUND, self.calibrated - start)
            index = self.sampler.draw(problem, table, start, count, FIVE)
            F, score = self._verify(problem, points, *calibrated_hypotheses(problem, index, start), subset)
            self._remember(state, everything, F, score)
        return state

    def _near(self, F: Float[Tensor, "9 p k"], problem: Problem) -> Problem:
        """The same pairs with at most `refine_matches` of their matches, of those near one of the models."""
        most = self.refine_matches
        if most is None:
            return problem
        r2 = sampson_squared(F, problem.points.to(torch.float32)).nan_to_num_(torch.inf).amin(1)
        near = problem.live & (r2 * problem.unit.square()[:, None].to(r2.dtype) <= self.reach**2)
        order = random.bits(problem.seed, problem.key, Stream.REFINEMENT, 0, near.shape[1], 1)[..., 0]
        order = torch.where(near, order, torch.iinfo(torch.int64).max)
        longest = min(most, max(int(near.sum(1).max()), 1))
        return problem.take(torch.sort(order, dim=1, stable=True).indices[:, :longest], near)

    def _search(self, problem: Problem) -> _Search:
        p, device = len(problem.pair), problem.points.device
        points = problem.points.to(torch.float32)
        table = self.sampler.table(problem, self.solver.size)
        subset = self._subset(problem)
        state = _Search.empty(p, self.pool, device)
        active = torch.arange(p, device=device)
        start = 0
        while start < self.hypotheses and len(active):
            count = min(self.round, self.hypotheses - start)
            every = len(active) == p
            some, some_points = problem.only(active), points if every else points[:, active]
            drawn, valid, index = self._hypotheses(some, some_points, table[active], start, count)
            F, score = self._verify(some, some_points, drawn, valid, None if subset is None else subset[active])
            if self.degeneracy is not None:
                F, score = self.degeneracy(F, score, state.score[active, 0], drawn, index, some, start)
            self._remember(state, active, F, score)
            start += count
            state.draws[active] = start
            if self.confidence is not None and start < self.hypotheses:
                done = self._done(state, active, some, some_points)
                active = active[~done]
        return state

    def _hypotheses(
        self, problem: Problem, points: Float[Tensor, "4 p n"], table: Tensor, start: int, count: int
    ) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"], Int[Tensor, "size p s"]]:
        """The models of `count` minimal samples, in the order of their draws, which of them exist, and the samples."""
        size = self.solver.size
        index = self.sampler.draw(problem, table, start, count, size)
        sample = torch.stack([points.gather(2, i.expand(4, -1, -1)) for i in index], 1)
        return *self.solver(sample), index

    def _verify(
        self, problem: Problem, points: Tensor, F: Tensor, valid: Tensor, subset: Tensor | None
    ) -> tuple[Float[Tensor, "9 p k"], Float[Tensor, "p k"]]:
        """The valid models and their scores, the weaker ones dropped after a look at the `subset` of matches."""
        F, valid = _front(F, valid)
        if subset is not None and F.shape[2] > self.survivors:
            coarse = score_models(self.coarse, F, problem, points, subset, valid)
            order = torch.sort(coarse, dim=1, descending=True, stable=True).indices[:, : self.survivors]
            order = torch.sort(order, dim=1).values  # back in the order of the draws, which breaks ties
            F, valid = F.gather(2, order.expand(9, -1, -1)), valid.gather(1, order)
        return F, score_models(self.score, F, problem, points, valid=valid)

    def _remember(self, state: _Search, active: Tensor, F: Tensor, score: Tensor) -> None:
        """Keep the best models of each pair; the earlier draw wins a tie."""
        all_F = torch.cat([state.F[:, active], F], 2)
        all_scores = torch.cat([state.score[active], score], 1)
        k = state.score.shape[1]
        top, order = torch.sort(all_scores, dim=1, descending=True, stable=True)
        state.score[active] = top[:, :k]
        state.F[:, active] = all_F.gather(2, order[:, :k].expand(9, -1, -1))

    def _done(self, state: _Search, active: Tensor, problem: Problem, points: Tensor) -> Bool[Tensor, " p"]:
        """Whether the best models may be taken for the best there are."""
        best = state.F[:, active, 0].to(points.dtype)
        return self._enough(best, state.draws[active], problem, self.solver.size)

    def _enough(
        self, F: Float[Tensor, "9 p"], draws: Int[Tensor, " p"], problem: Problem, size: int
    ) -> Bool[Tensor, " p"]:
        """Whether an all-inlier sample was drawn with probability `confidence` (Fischler & Bolles 1981)."""
        if self.confidence is None:
            return torch.zeros_like(draws, dtype=torch.bool)
        r2 = sampson_squared(F[..., None].contiguous(), problem.points.to(F.dtype))[:, 0]
        support = r2 <= (self.inlier_threshold / problem.unit).square().to(r2.dtype)[:, None]
        weight = self.sampler.weight(problem)
        share = torch.where(support, weight, 0).sum(1).to(torch.float64) / weight.sum(1)
        all_inliers = share
        for _ in range(size - 1):  # a power would not have the same last bits everywhere
            all_inliers = all_inliers * share
        missed = torch.log1p(-all_inliers.clamp(max=1 - 1e-12)) * draws
        return missed <= math.log1p(-self.confidence)

    def _subset(self, problem: Problem) -> Int[Tensor, "p k"] | None:
        """The live matches on which models are preselected: those with the smallest hash."""
        n = problem.live.shape[1]
        if not self.preselect or n < 2 * self.preselect:
            return None
        order = random.bits(problem.seed, problem.key, Stream.PRESELECTION, 0, n, 1)[..., 0]
        order = torch.where(problem.live, order, torch.iinfo(torch.int64).max)
        return torch.sort(order, dim=1, stable=True).indices[:, : self.preselect].contiguous()


def _front(F: Float[Tensor, "9 p m"], valid: Bool[Tensor, "p m"]) -> tuple[Tensor, Tensor]:
    """Valid models moved to the front in their order; what is invalid for every pair is cut off."""
    longest = int(valid.sum(1).max())
    order = torch.sort((~valid).to(torch.uint8), dim=1, stable=True).indices[:, :longest]
    return F.gather(2, order.expand(9, -1, -1)), valid.gather(1, order)
