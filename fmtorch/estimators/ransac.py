"""Hypothesise and verify: four verbs whose parts make RANSAC, MSAC, LMedS and their descendants.

**search**: rounds of minimal samples, scores, the best models; **refine** these; **select** one; **fit** it. The engine
is control flow on one pair: `PARTS` names the parts, which hold the arithmetic, and beside which the options of each
verb are described; `batch` leads from tensors to pairs and back."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, TypeVar

import numpy as np

from fmtorch.core.options import Within, expect_options, parameters_of
from fmtorch.core.stages import Estimator
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.estimators import focal_search, inliers, lens_search, preselection, refinement, sampling, scores
from fmtorch.estimators.batch import NOT_SOLVED, Estimation, Solution
from fmtorch.estimators.focal_search import Focal, FocalSearch
from fmtorch.estimators.gradients import Attached
from fmtorch.estimators.graph_cut import GraphCut
from fmtorch.estimators.inliers import InlierRule, StoppingRule, noise_scale, residuals_squared_px, squared_in_noises
from fmtorch.estimators.models import focal_prior, fundamental, posterior, with_focals
from fmtorch.estimators.models.fundamental import EightPoint, FitScale, Homography, Matrices, SevenPoint
from fmtorch.estimators.pair import Lens, Pair, across_lines, normalize_pair, to_pixels
from fmtorch.estimators.preselection import Count, Preselect, Preselection
from fmtorch.estimators.refinement import Adaptive, Fit, GaussNewton, LeastSquares, NoFit, UnweightedLeastSquares
from fmtorch.estimators.search import Degensac, Search, merge
from fmtorch.geometry import homography_refine, levenberg_marquardt
from fmtorch.geometry.epipolar import HOMOGRAPHY, SAMPSON
from fmtorch.geometry.five_point import five_point
from fmtorch.geometry.homography import four_point
from fmtorch.geometry.refine import refine_kernel
from fmtorch.geometry.seven_point import seven_point_kernel
from fmtorch.geometry.significance import counted_chances, judged, most_significant
from fmtorch.jit.kernel import Array, Kernel, compile_together
from fmtorch.jobs.execution import mapped

FOCAL_ROUND = 500  # samples of five matches at a time
SEARCHED = 2048  # right matches that suffice for a search
ACCIDENTAL, ACCIDENTAL_SHARE = 3, 0.01  # wrong matches that lie beside their epipolar lines: so many, and of all
CALIBRATED_MATCHES = 6  # that a pair of calibrated cameras needs: five of them have up to ten solutions
DEFAULT_PRESELECT = Preselect()
Probability = Annotated[float, Within(0, 1, exclusive=True)]
DEFAULT_THRESHOLD_PX = 1.0
Stage = TypeVar("Stage")

PARTS: dict[str, dict[str, Callable[..., Any]]] = {
    "solver": {"seven_point": SevenPoint, "eight_point": EightPoint, "four_point": Homography},
    "sampler": {"uniform": sampling.Uniform, "prosac": sampling.Prosac, "prior": sampling.PriorWeighted},
    "score": {
        "inlier_count": scores.InlierCount, "msac": scores.Msac, "saturated": scores.SaturatedGains,
        "magsac": scores.Magsac, "median": scores.Median,
    },
    "degeneracy": {"degensac": Degensac},
    "local_optimization": {"graph_cut": GraphCut},
    "inliers": {"threshold": inliers.WithinThreshold, "median": inliers.BetterHalf, "lmeds": inliers.RobustDeviations},
    "final": {
        "none": NoFit, "least_squares": LeastSquares, "unweighted_least_squares": UnweightedLeastSquares,
        "gauss_newton": GaussNewton, "adaptive": Adaptive,
    },
}  # fmt: skip
"""An option that names a part holds its name (``score: msac``), or a mapping of its name and options of its own
(``score: {name: msac, prior_weighted: true}``), or an object: that of a user's `_target_`."""


def takes(role: str, spec: Any, option: str) -> bool:
    """Whether a named part asks the engine for this option."""
    name = spec.get("name") if isinstance(spec, Mapping) else spec
    make = PARTS[role].get(name) if isinstance(name, str) else None
    return make is not None and option in parameters_of(make)


def part(role: str, spec: Any, **context: Any) -> Any:
    """The part that an option describes, None for none.
    context: what the engine tells its parts; each takes what its constructor names, unless its own options say so.
    Raises ValueError for an unknown name or option, naming those there are."""
    if spec is None or not isinstance(spec, str | Mapping):
        return spec
    name, options = (spec, {}) if isinstance(spec, str) else (spec.get("name"), dict(spec))
    options.pop("name", None)
    if name not in PARTS[role]:
        raise ValueError(f"{role} is {name!r}; it must be one of: {', '.join(PARTS[role])}")
    make = PARTS[role][name]
    known = {key: value for key, value in context.items() if key in parameters_of(make)}
    expect_options(make, options, f"{role}={name}", known)
    return make(**(known | options))


def stage(options: Stage | Mapping[str, Any] | None, kind: type[Stage]) -> Stage | None:
    """The options of a stage, from a mapping or as they are; None where it is left out."""
    return kind(**options) if isinstance(options, Mapping) else options


def thresholds(
    threshold: float | None, inlier_threshold: float | None, score: Any, inliers: Any, stops: bool, optimization: Any
) -> tuple[float, float]:
    """The thresholds of score and of inliers, px; ValueError where one is given that nothing asks for. score, inliers,
    optimization: as options name these parts. stops: whether there is a stopping rule, which counts inliers."""
    by_distance = stops or takes("inliers", inliers, "threshold")
    if inlier_threshold is not None and not by_distance:
        raise ValueError(f"inlier_threshold={inlier_threshold} has no effect: inliers={inliers} takes none")
    scored = takes("score", score, "threshold") or optimization is not None
    if threshold is not None and not scored and (not by_distance or inlier_threshold is not None):
        raise ValueError(f"threshold={threshold} has no effect: score={score} takes none, nor does anything else")
    of_score = DEFAULT_THRESHOLD_PX if threshold is None else threshold
    return of_score, of_score if inlier_threshold is None else inlier_threshold


class Ransac:
    """A robust estimator of fundamental matrices, batched over pairs.

    Parts are named as in `PARTS`; the options of a stage are those of the class that is named there.

    Args:
        solver: minimal solver, `seven_point` or `eight_point`, and with it the family of models; `four_point` for
            homographies.
        sampler: draws the matches of a sample, `uniform`, `prosac` or `prior`.
        score: by which models are compared.
        threshold: Sampson distance in pixels up to which a match supports a model; None: 1.
        hypotheses: minimal samples drawn at most.
        round: samples between two looks at the stopping rule.
        confidence: stop once an all-inlier sample was drawn with this probability; None: never before `hypotheses`.
        preselect: `Preselect`, the models of a round compared on few matches first; None: all are scored on all.
        degeneracy: `degensac` completes a best model whose sample lies on a plane by plane and parallax; None.
        pool: the best models that are kept to the end.
        local_optimization: of the pool, `graph_cut`; None.
        refine: `Refine`, Levenberg-Marquardt from each model of the pool; None.
        select: `Select`, by which score the estimate is selected from the refined pool; None: the search's own.
        focal: `Focal`, the prior on focal lengths, where the image sizes are known: for whole photographs, not crops.
            Models of five matches and drawn focal lengths are searched first, in rounds, until all good candidates are
            one model or enough rounds confirm the best one, and the stopping rule is content. They suffice for a pair
            whose images have one size, if that rule is content; other pairs are searched without assumptions, too, and
            both kinds compared. Where a focal length is known, they suffice. Needs `select`.
        inliers: `threshold`, `lmeds` (2.5 robust standard deviations) or `median` (the better half).
        inlier_threshold: of the inliers reported and of the stopping rule, Sampson distance in pixels; None: the
            threshold.
        final: `least_squares` (8-point on the inliers, weighted by prior and noise where there is a prior),
            `unweighted_least_squares` (all inliers alike), `gauss_newton` (one step), `adaptive` (refined at the pair's
            own noise, with the prior on focal lengths unless the matches contradict it) or `none`.
        refit_inliers: recompute the inliers after the final fit.
        coarsest: a pair whose matches are coarser than the distances in pixels are for is estimated again with twice,
            four times ... these, at most so many times; its inliers are those of the inlier threshold, as ever.

    Raises:
        ValueError: for an unknown part or option, and for one that would have no effect, such as a threshold where
            neither score nor inliers have one.

    Memory: for each thread some 300 bytes a match of one pair, and 1 MB of models."""

    def __init__(
        self,
        *,
        solver: str | Mapping[str, Any] | Matrices = "seven_point",
        sampler: str | Mapping[str, Any] | sampling.Sampler = "uniform",
        score: str | Mapping[str, Any] | scores.Score = "msac",
        threshold: refinement.Pixels | None = None,
        hypotheses: Count = 2000,
        round: Count = 500,
        confidence: Probability | None = 0.9999,
        preselect: Preselect | Mapping[str, Any] | None = DEFAULT_PRESELECT,
        degeneracy: str | Mapping[str, Any] | None = None,
        pool: Count = 1,
        local_optimization: str | Mapping[str, Any] | refinement.LocalOptimization | None = None,
        refine: refinement.Refine | Mapping[str, Any] | None = None,
        select: refinement.Select | Mapping[str, Any] | None = None,
        focal: Focal | Mapping[str, Any] | None = None,
        inliers: str | Mapping[str, Any] | InlierRule = "threshold",
        inlier_threshold: refinement.Pixels | None = None,
        final: str | Mapping[str, Any] | NoFit = "least_squares",
        refit_inliers: bool = True,
        coarsest: Count = 1,
    ) -> None:
        expect_options(Ransac, {name: value for name, value in locals().items() if name != "self"}, "")
        stops = confidence is not None
        threshold, inlier_px = thresholds(threshold, inlier_threshold, score, inliers, stops, local_optimization)
        self.family: Matrices = part("solver", solver)
        self.sampler: sampling.Sampler = part("sampler", sampler)
        self.score: scores.Score = part("score", score, threshold=threshold)
        self.inlier_rule: InlierRule = part("inliers", inliers, threshold=inlier_px)
        self.final: NoFit = part("final", final)
        self.refit_inliers, self.coarsest = refit_inliers, coarsest
        stop = None if confidence is None else StoppingRule(confidence, inlier_px, self.sampler)
        preselection = Preselection(self.score, stage(preselect, Preselect))
        check = part("degeneracy", degeneracy, score=self.score)
        if check is not None and self.family.size != Degensac.SAMPLE:
            raise ValueError(f"degeneracy={degeneracy} needs solver=seven_point; solver is {solver!r}")
        of_fundamental = {"degeneracy": check, "local_optimization": local_optimization, "focal": focal}
        wrong = [name for name, value in of_fundamental.items() if value is not None]
        if wrong and self.family.model != "fundamental":
            raise ValueError(f"{wrong[0]} is for fundamental matrices; the solver gives {self.family.model} matrices")
        self.search = Search(self.family, self.sampler, preselection, pool, hypotheses, round, stop, check)
        optimization = part("local_optimization", local_optimization, threshold=threshold, score=self.score)
        choice = stage(select, refinement.Select)
        self.refine = refinement.Refinement(stage(refine, refinement.Refine), optimization)
        self.select = refinement.BestScore(self.score)
        if choice is not None:
            own = self.family.fit_scale._replace(scale_sigmas=choice.own_noise or 0.0)
            first: Any = part("score", choice.score, threshold=choice.scale)
            own_scale = isinstance(choice.score, Mapping) and "threshold" in choice.score
            scaled = choice.own_noise and takes("score", choice.score, "threshold") and not own_scale
            self.select = refinement.BestScore(first, functools.partial(_at_noise, first, own) if scaled else None)
        self.focal = self._focal_search(stage(focal, Focal), choice)

    def _focal_search(self, options: Focal | None, choice: refinement.Select | None) -> FocalSearch | None:
        if options is None:
            return None
        if choice is None:
            raise ValueError("focal needs select: the score by which models with the prior are compared")
        family, own, search = with_focals.FundamentalWithFocals(), None, self.search
        if options.samples:
            own = Search(family, search.sampler, search.preselection, options.pool, options.samples, FOCAL_ROUND)
        return FocalSearch(options, family, self.select, self.refine, own, search.stop)

    @property
    def model(self) -> str:
        """What its matrices are, `Estimate.model`."""
        return self.family.model

    @property
    def kernels(self) -> tuple[Kernel[..., Any], ...]:
        """Those worth compiling together, before the first pair."""
        if self.focal is not None:
            return WITH_FOCALS
        return OF_HOMOGRAPHIES if self.family.model == "homography" else ()

    @property
    def gradients_reach(self) -> tuple[str, ...]:
        """The fields of `Correspondences` that gradients of the estimate reach."""
        return Attached(self.final, self.family).reached

    @property
    def assumes_cameras(self) -> bool:
        """Whether image sizes make a difference to the search."""
        return self.focal is not None

    @property
    def uses_prior(self) -> bool:
        """Whether a prior makes a difference to the search."""
        return getattr(self.sampler, "uses_prior", False) or getattr(self.score, "prior_weighted", False)

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the fundamental matrices of a batch of pairs; a pair that cannot be solved is `ok=False`."""
        compile_together(self.kernels)
        estimation = Estimation(c, seed, self.family, self.family.size, CALIBRATED_MATCHES if self.focal else None)

        def estimate_part(part: Sequence[int]) -> None:
            with np.errstate(all="ignore"):  # infinite or NaN beyond the range of a float
                for row in estimation.rows(part):
                    estimation.put(row, self.estimate(row.pair))

        each = mapped if len(estimation.parts) > 1 else map
        list(each(estimate_part, estimation.parts))
        return estimation.estimates(Attached(self.final, self.family))

    def estimate(self, pair: Pair) -> Solution:
        """Search to fit of one pair, which is the search's own."""
        if self.focal is not None and self.focal.options.sqrt_prior and pair.sizes_known:
            np.sqrt(pair.match_weight, out=pair.match_weight)
        solution, times = self._of_one_scale(pair), 1
        while times < self.coarsest and solution.fit is not None:
            r2, noise = _distances(solution.fit, solution.lens, pair)
            if not inliers.coarse(r2 / np.square(times * noise)):
                break
            times *= 2
            coarser = self._of_one_scale(pair.reduced(times))
            if coarser.fit is None:
                break
            solution = coarser._replace(samples=solution.samples + coarser.samples)
        if times == 1 or solution.fit is None:
            return solution
        within = self.inlier_rule(_distances(solution.fit, solution.lens, pair)[0], pair)
        seen = None if pair.stretch is None else across_lines(pair, solution.fit.F)
        return solution._replace(inliers=within, pair=seen)

    def _of_one_scale(self, pair: Pair) -> Solution:
        """The same at the distances in pixels of the options."""
        if pair.lens is not None:
            return self._with_lenses(pair, pair.lens)
        solution = self._of_pinholes(pair)
        if self.focal is None or solution.fit is None or not pair.sizes_known:
            return solution
        return solution._replace(lens_suggested=lens_search.suggested_lens(solution.fit, searched(pair)))

    def _of_pinholes(self, pair: Pair) -> Solution:
        """Where cameras are calibrated and all but still, the search is repeated without the matches of outlying
        parallax, and what it finds is taken if it loses no more of these than may be inliers by accident."""
        first = self._search_and_fit(pair, searched(pair))
        outlying = focal_search.outlying(first.fit, first.inliers, pair)
        if outlying is None or first.inliers is None:
            return first
        second = self._search_and_fit(pair, searched(pair.ignoring(outlying)))
        if second.inliers is None:
            return first
        accidental = ACCIDENTAL + ACCIDENTAL_SHARE * (pair.count - np.count_nonzero(first.inliers))
        better = np.count_nonzero(outlying & first.inliers & ~second.inliers) <= accidental
        return (second if better else first)._replace(samples=first.samples + second.samples)

    def _search_and_fit(self, pair: Pair, near: Pair) -> Solution:
        """Search to fit, the search among some matches: of plausible cameras first where the image sizes are known, and
        without assumptions where these are doubtful."""
        plausible, draws, focal = None, 0, self.focal if pair.sizes_known else None
        if focal is not None and focal.search is not None:
            plausible, settled, draws = focal(near)
            if settled:
                solution = self._fitted(pair, plausible.selection, draws)
                if solution.fit is None or solution.fit.gain <= refinement.DOUBTFUL_GAIN:
                    return solution
        pool = self.search(near)
        free = self.refine(pool, near, self.family)
        selection = self.select(free, near) if focal is None else focal.select(free, near, plausible)
        return self._fitted(pair, selection, draws + pool.samples)

    def _fitted(self, pair: Pair, selection: refinement.Selection, draws: int) -> Solution:
        if not selection.valid:
            return Solution(None, draws, reason=NOT_SOLVED)
        pair = across_lines(pair, selection.F)
        inliers = self.inliers(selection.F, pair)
        fit: Fit = self.final(selection, pair, inliers, self.family)
        if self.refit_inliers:
            inliers = self.inliers(fit.F, across_lines(pair, fit.F))
        return Solution(fit, draws, inliers, pair=None if pair.stretch is None else pair)

    def _with_lenses(self, pair: Pair, known: Lens) -> Solution:
        """The same of bent photographs: searched in images of pinholes, judged as photographed."""
        assert self.focal is not None
        lens = lens_search.lenses_of(pair, self.focal)
        solution = self._of_pinholes(lens_search.undistorted(pair, lens))
        if solution.fit is None or solution.inliers is None:
            return solution
        cameras = solution.fit.cameras
        if not lens.any() and (cameras is None or not all(0 < s < math.inf for s in known.deviations)):
            return solution._replace(lens=lens)
        if cameras is not None:
            fit = lens_search.lens_fit(lens, cameras, pair, solution.inliers)
            if fit.lens is not None and np.isfinite(fit.F).all():
                inliers = self.inlier_rule(lens_search.squared_px(fit.F, fit.lens.lens, pair), pair)
                return Solution(fit, solution.samples, inliers, lens=fit.lens.lens, deviation=fit.lens.deviation)
        free = solution.fit._replace(counted=np.zeros(pair.count))  # without cameras there are no gradients
        return solution._replace(lens=lens, fit=free)

    def inliers(self, F: Array, pair: Pair) -> Array:
        """The inliers (n,) of a model (9,)."""
        inliers = self.inlier_rule(residuals_squared_px(F, pair), pair)
        if not isinstance(inliers, np.ndarray) or inliers.shape != (pair.count,) or inliers.dtype != bool:
            what = f"{inliers.dtype} {inliers.shape}" if isinstance(inliers, np.ndarray) else type(inliers).__name__
            raise ValueError(
                f"{type(self.inlier_rule).__name__} returns {what}; it must be an array of bool ({pair.count},): "
                "whether each match is an inlier"
            )
        return inliers


def searched(pair: Pair) -> Pair:
    """The matches that are searched: of a pair with a prior as many, evenly along its list, as count like `SEARCHED`
    right ones. Of more, as of dense matchers, a model's score says no more; the final fit has them all."""
    if pair.prior is None or pair.count <= SEARCHED:
        return pair
    count = math.ceil(pair.count * SEARCHED / max(float(pair.prior.sum()), 1.0))
    return pair if count >= pair.count else pair.take(np.arange(count) * pair.count // count)


def _distances(fit: Fit, lens: Array | None, pair: Pair) -> tuple[Array, Array]:
    """Squared residuals (n,) of a fit for lenses (2,) that are estimated, px^2, and the noise of these distances."""
    if fit.lens is not None:
        return lens_search.squared_px(fit.F, fit.lens.lens, pair), pair.noises
    seen = across_lines(pair if lens is None else lens_search.undistorted(pair, lens), fit.F)
    return residuals_squared_px(fit.F, seen), seen.noises if seen.stretch is None else seen.noises / seen.stretch


def _at_noise(score: scores.SummedGains, own: FitScale, F: Array, pair: Pair) -> scores.Score:
    """A score at the noise of a pair near a model (9,)."""
    return score.at(noise_scale(squared_in_noises(F, pair), pair, own, own.largest_px))


class CoarseToFine:
    """Coarse-to-Fine RANSAC (Bian et al., BMVC 2019, section 5): the fine estimator sees the inliers of the coarse one.

    coarse: an estimator that prunes well, GC-RANSAC or USAC in the paper. fine: one that fits well, LMedS in the paper.
    A pair that one of them cannot solve is ``ok=False`` with that one's reason; `samples` counts those of both.
    Its significance is that among all matches, also those which the coarse one dropped.
    Gradients are the fine estimator's: the coarse one only chooses matches."""

    def __init__(self, *, coarse: Estimator, fine: Estimator) -> None:
        self.coarse, self.fine = coarse, fine

    @property
    def uses_prior(self) -> bool:
        """Whether a prior makes a difference to one of the two."""
        return any(getattr(stage, "uses_prior", False) for stage in (self.coarse, self.fine))

    @property
    def gradients_reach(self) -> tuple[str, ...]:
        """Those of the fine estimator."""
        return tuple(getattr(self.fine, "gradients_reach", ("x0", "x1", "prior", "noise")))

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the fundamental matrices of a batch of pairs."""
        coarse = self.coarse(c.detach(), seed)
        fine = self.fine(c.keep(coarse.inliers & coarse.ok[:, None]), seed)
        reasons = tuple(
            f"coarse: {first}" if first else f"fine: {second}" if second else ""
            for first, second in zip(coarse.reason, fine.reason, strict=True)
        )
        return judged(fine.replace(reason=reasons, samples=coarse.samples + fine.samples, significance=None), c)


# Kernels that two processes compile side by side, by what they share, the slowest to compile at both ends

WITH_FOCALS: tuple[Kernel[..., Any], ...] = (  # of an estimator of fundamental matrices with the prior on focal lengths
    # Solvers, samples and scores
    five_point, seven_point_kernel, counted_chances, refinement.near_of(SAMPSON), sampling.draw,
    focal_prior.draw_depths, preselection.draw_by_prior, preselection.best, scores.score_gains_of(SAMPSON),
    scores.score_saturated_of(SAMPSON), normalize_pair, to_pixels, preselection.support, inliers.residuals_squared,
    inliers.share_within, merge, scores.saturated_cells, scores.pack, focal_search.posteriors,
    focal_search.distinct_models, focal_search.same_model,
    # Cameras and fits; `evaluate` is called by `minimise` and `refine`
    posterior.centre, posterior.translate, posterior.beside_rotations, with_focals.gain_without_prior,
    with_focals.refine_with_prior, with_focals.cheirality, most_significant, posterior.nearest_cameras,
    levenberg_marquardt.evaluate, refine_kernel, posterior.minimise, lens_search.summed_with_lenses,
    lens_search.minimise_with_lenses,
)  # fmt: skip

OF_HOMOGRAPHIES: tuple[Kernel[..., Any], ...] = (
    homography_refine.refine_homographies, homography_refine.evaluate_homographies, four_point,
    fundamental.homography_to_pixels, inliers.residuals_squared_of(HOMOGRAPHY), refinement.near_of(HOMOGRAPHY),
    scores.score_gains_of(HOMOGRAPHY), scores.score_saturated_of(HOMOGRAPHY), counted_chances,
)  # fmt: skip
"""Of an estimator of homographies, beside those that the former has too."""
