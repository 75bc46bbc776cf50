"""Hypothesise and verify: four verbs whose parts make RANSAC, MSAC, LMedS and their descendants.

**search**: rounds of minimal samples, scores, the best models; **refine** these; **select** one; **fit** it. The engine
is control flow: `registry` names the parts, which hold the arithmetic, `options` describes those of each verb. Search,
refinement and selection run without gradients; the fit is attached to the caller's graph.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from fmtorch.compiling import switch
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators.batching import solve_all
from fmtorch.estimators.degeneracy import Degensac
from fmtorch.estimators.final_fits import FinalFit
from fmtorch.estimators.focal.hypotheses import FocalSamples
from fmtorch.estimators.focal.selection import FocalSelection
from fmtorch.estimators.forms import Form, Outcome, pair_by_pair
from fmtorch.estimators.graph_cut import LocalOptimization
from fmtorch.estimators.inliers import Confidence, InlierRule
from fmtorch.estimators.one_pair import ahead
from fmtorch.estimators.one_pair.batch import estimated
from fmtorch.estimators.one_pair.whole import whole
from fmtorch.estimators.options import Focal, Preselect, Refine, Select, at_least_one, group, thresholds
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.pool import Verifier
from fmtorch.estimators.refinement import AsFound, PoolRefinement
from fmtorch.estimators.registry import part
from fmtorch.estimators.sampling import Sampler
from fmtorch.estimators.scores import Score
from fmtorch.estimators.search import Search
from fmtorch.estimators.selection import BestScore, FirstOfPool, Selector
from fmtorch.estimators.solvers import MinimalSamples, Solver
from fmtorch.estimators.verbs import FocalParts, Verbs

FOCAL_ROUND = 500  # samples of five matches of a pair at a time
DEFAULT_PRESELECT = Preselect()
NOT_FOUND = "every minimal sample was degenerate"


class HypothesizeAndVerify:
    """A robust estimator of fundamental matrices, batched over pairs.

    Parts are named as in `registry`; the options of a stage are those of the class of that name in `options`.

    Args:
        solver: minimal solver, `seven_point` or `eight_point`.
        sampler: draws the matches of a sample, `uniform`, `prosac` or `prior`.
        score: by which models are compared.
        threshold: Sampson distance in pixels up to which a match supports a model; None: 1.
        hypotheses: minimal samples drawn at most.
        round: samples between two looks at the stopping rule.
        confidence: stop once an all-inlier sample was drawn with this probability; None: never before `hypotheses`.
        preselect: `Preselect`, a first look at the models of a round on few matches; None: all are scored on all.
        degeneracy: `degensac` completes a best model whose sample lies on a plane by plane and parallax; None.
        pool: the best models that are kept to the end.
        local_optimization: of the pool, `graph_cut`; None.
        refine: `Refine`, Levenberg-Marquardt from each model of the pool; None.
        select: `Select`, by which score the estimate is selected from the refined pool; None: the search's own.
        focal: `Focal`, the prior on focal lengths, where the image sizes are known: for whole photographs, not crops.
            Models of five matches and drawn focal lengths are searched first, in rounds, until all good candidates are
            one model or enough rounds find the best one before them again, and the stopping rule is content. They
            suffice for a pair whose images have one size, if that rule is content; other pairs are searched without
            assumptions, too, and both kinds compared. Needs `select`.
        inliers: `threshold`, `lmeds` (2.5 robust standard deviations) or `median` (the better half).
        inlier_threshold: of the inliers reported and of the stopping rule, Sampson distance in pixels; None: the
            threshold.
        final: `least_squares` (8-point on the inliers, weighted by prior and noise where there is a prior),
            `unweighted_least_squares` (all inliers alike), `gauss_newton` (one attached step), `adaptive` (refined at
            the pair's own noise, with the prior on focal lengths unless the matches contradict it) or `none`.
        refit_inliers: recompute the inliers after the final fit.

    Raises:
        ValueError: for an unknown part or option, and for one that would have no effect, such as a threshold where
            neither score nor inliers have one.

    Memory: for a batch of pairs of N matches, the points (48 N bytes a pair), the samples of 2^14 draws (about 40 MB),
    2^10 samples of five (about 20 MB) and eight buffers of one scoring tile (256 KB each); on a GPU 2^21 draws, 2^19
    samples of five and 256 MB a buffer.
    """

    def __init__(
        self,
        *,
        solver: str | Mapping[str, Any] | Solver = "seven_point",
        sampler: str | Mapping[str, Any] | Sampler = "uniform",
        score: str | Mapping[str, Any] | Score = "msac",
        threshold: float | None = None,
        hypotheses: int = 2000,
        round: int = 500,
        confidence: float | None = 0.9999,
        preselect: Preselect | Mapping[str, Any] | None = DEFAULT_PRESELECT,
        degeneracy: str | Mapping[str, Any] | None = None,
        pool: int = 1,
        local_optimization: str | Mapping[str, Any] | LocalOptimization | None = None,
        refine: Refine | Mapping[str, Any] | None = None,
        select: Select | Mapping[str, Any] | None = None,
        focal: Focal | Mapping[str, Any] | None = None,
        inliers: str | Mapping[str, Any] | InlierRule = "threshold",
        inlier_threshold: float | None = None,
        final: str | Mapping[str, Any] | FinalFit = "least_squares",
        refit_inliers: bool = True,
    ) -> None:
        at_least_one(hypotheses=hypotheses, round=round, pool=pool)
        if confidence is not None and not 0 < confidence < 1:
            raise ValueError(f"confidence is {confidence}; it is a probability between 0 and 1, or null")
        stops = confidence is not None
        threshold, inlier_px = thresholds(threshold, inlier_threshold, score, inliers, stops, local_optimization)
        self.sampler, self.score = part("sampler", sampler), part("score", score, threshold=threshold)
        generator = MinimalSamples(part("solver", solver), self.sampler)
        check = part("degeneracy", degeneracy, score=self.score)
        if check is not None and generator.size != Degensac.SAMPLE:
            raise ValueError(f"degeneracy={degeneracy} needs solver=seven_point; solver is {solver!r}")
        self.confidence = None if confidence is None else Confidence(confidence, inlier_px, self.sampler)
        verify = Verifier(self.score, group("preselect", preselect, Preselect))
        self.search = Search(generator, verify, pool, hypotheses, round, self._confident(generator.size), check)
        optimization = part("local_optimization", local_optimization, threshold=threshold, score=self.score)
        refinement = group("refine", refine, Refine)
        choice, prior = group("select", select, Select), group("focal", focal, Focal)
        gain = None if choice is None else part("score", choice.score, threshold=choice.scale)
        self.selector: Selector = BestScore(self.score) if gain is None else BestScore(gain, torch.float64)
        self.refine: PoolRefinement | AsFound = PoolRefinement(refinement, optimization)
        if gain is None and optimization is None and refinement is None:
            self.selector, self.refine = FirstOfPool(), AsFound()
        self.focal = None
        if prior is not None:
            if gain is None:
                raise ValueError("focal needs select: the score by which models with the prior are compared")
            self.focal = FocalParts(FocalSelection(gain, prior.iterations, prior.candidates))
            if prior.samples:
                samples = Search(FocalSamples(self.sampler.draw), verify, prior.pool, prior.samples, FOCAL_ROUND)
                self.focal = dataclasses.replace(
                    self.focal, search=samples, samples=prior.samples, rounds=prior.rounds, min_rounds=prior.min_rounds,
                    confirmations=prior.confirmations, confident=self._confident(FocalSamples.size),
                )  # fmt: skip
        self.final = part("final", final)
        verbs = Verbs(self.search, self.refine, self.selector, self.focal)
        self.tensor_form = Form(verbs, part("inliers", inliers, threshold=inlier_px), self.final, refit_inliers)
        self.kernel_form = whole(self.tensor_form)

    @property
    def uses_prior(self) -> bool:
        """Whether a prior makes a difference to the search."""
        return getattr(self.sampler, "uses_prior", False) or getattr(self.score, "prior_weighted", False)

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the fundamental matrices of a batch of pairs; a pair that cannot be solved is `ok=False`."""
        least = self.search.generator.size
        form: Callable[[NormalizedPairs], Outcome] = self.tensor_form
        compiled = self.kernel_form if c.mask.device.type == "cpu" and switch.available() else None
        if compiled is not None:
            if self.focal is not None:
                ahead.compiled()
            if not c.requires_grad:
                return estimated(c, seed, least, compiled, NOT_FOUND)
            form = functools.partial(pair_by_pair, compiled)
        at_once = self.search.generator.samples_at_once(c.mask.device) // self.search.round
        solve = functools.partial(self._solve, form)
        return solve_all(c, seed, least, solve, NOT_FOUND, at_once, compiled is not None)

    def _solve(
        self, form: Callable[[NormalizedPairs], Outcome], pairs: NormalizedPairs
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Search to fit: F (p, 3, 3) in normalised units, inliers (p, n), found (p,), draws (p,).

        F is attached to the graph of points, prior and noise where one is recorded.
        """
        with torch.no_grad():
            fit, inliers, found, draws = form(pairs)
        F = fit.F + self.final.attached(fit, pairs) if pairs.requires_grad else fit.F
        return F, inliers, found, draws

    def _confident(self, size: int) -> Any:
        """The stopping rule for samples of this size; None: never stop before all samples are drawn."""
        return None if self.confidence is None else functools.partial(self.confidence, size=size)
