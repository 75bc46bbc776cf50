"""The kernel form of a whole estimator, made of its tensor form."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from fmtorch.estimators import refinement, selection
from fmtorch.estimators.forms import Form
from fmtorch.estimators.one_pair.focal.hypotheses import FocalSamples
from fmtorch.estimators.one_pair.focal.rounds import JoinedRounds
from fmtorch.estimators.one_pair.focal.selection import FocalSelection
from fmtorch.estimators.one_pair.inliers import Confidence
from fmtorch.estimators.one_pair.models import Pool
from fmtorch.estimators.one_pair.pool import Verifier
from fmtorch.estimators.one_pair.refinement import AsFound, PoolRefinement
from fmtorch.estimators.one_pair.selection import BestScore, FirstOfPool
from fmtorch.estimators.one_pair.solvers import MinimalSamples
from fmtorch.estimators.registry import kernel_form
from fmtorch.estimators.search import Search
from fmtorch.estimators.verbs import FocalParts, Verbs


class TensorsOnly(LookupError):
    """A part that has no kernel form."""


def whole(form: Form) -> Form | None:
    """The same parts in their kernel form; None unless each of them has one."""
    try:
        return Form(_verbs(form.selected), _part(form.inlier_rule), _part(form.final), form.refit_inliers)
    except TensorsOnly:
        return None


def _part(made: Any, *others: Any) -> Any:
    found = kernel_form(made, *others)
    if found is None:
        raise TensorsOnly(type(made).__name__)
    return found


def _verbs(parts: Any) -> Verbs:
    sampler = _part(parts.search.generator.sampler)
    search = _search(parts.search, MinimalSamples(_part(parts.search.generator.solver), sampler), sampler)
    refinement = _refinement(parts.refine)
    focal = None if parts.focal is None else _focal(parts.focal, sampler, refinement)
    return Verbs(search.rounds, refinement, _selector(parts.selector), focal)


def _search(search: Search, generator: Any, sampler: Any) -> Search:
    tensor_verify: Any = search.verify
    score, confident = _part(tensor_verify.score), _confident(search.confident, sampler)
    verify = Verifier(score, tensor_verify.preselect, tensor_verify.score.prior_weighted)
    check = None if search.degeneracy is None else _part(search.degeneracy, score)
    return dataclasses.replace(
        search, generator=generator, verify=verify, confident=confident, degeneracy=check, nothing=Pool.of
    )


def _confident(rule: Any, sampler: Any) -> Any:
    """A stopping rule for samples of one size."""
    return None if rule is None else functools.partial(Confidence(rule.func, sampler), **rule.keywords)


def _refinement(part: refinement.PoolRefinement | refinement.AsFound) -> PoolRefinement | AsFound:
    if isinstance(part, refinement.AsFound):
        return AsFound()
    optimization: Any = part.local_optimization
    if optimization is not None:
        optimization = _part(optimization, _part(optimization.score))
    return PoolRefinement(part.refine, optimization)


def _selector(part: Any) -> Any:
    return FirstOfPool() if isinstance(part, selection.FirstOfPool) else BestScore(_part(part.score))


def _focal(parts: FocalParts, sampler: Any, refinement: PoolRefinement | AsFound) -> FocalParts:
    chosen = FocalSelection(parts.selection, _part(parts.selection.gain))
    if parts.search is None:
        return dataclasses.replace(parts, selection=chosen)
    search = _search(parts.search, FocalSamples(sampler), sampler)
    found = dataclasses.replace(
        parts, selection=chosen, search=search.rounds, confident=_confident(parts.confident, sampler)
    )
    return JoinedRounds.of(found, search, refinement)
