"""Rounds with plausible cameras of one pair, each by one kernel where the parts are those that it joins."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from fmtorch.estimators.focal.round_kernels import candidates_of_five
from fmtorch.estimators.one_pair.focal.cameras import CentredPair, TwoCameras
from fmtorch.estimators.one_pair.focal.hypotheses import FocalSamples
from fmtorch.estimators.one_pair.focal.posterior import prior_of
from fmtorch.estimators.one_pair.focal.selection import Candidates, FocalSelection
from fmtorch.estimators.one_pair.pair import OnePair
from fmtorch.estimators.one_pair.refinement import AsFound, PoolRefinement
from fmtorch.estimators.one_pair.saturated_gains import SaturatedGains
from fmtorch.estimators.search import Search
from fmtorch.estimators.verbs import FocalParts

EVERY = np.iinfo(np.int64).max  # models survive where there is no first look


@dataclasses.dataclass(frozen=True)
class JoinedRounds(FocalParts):
    """As `FocalParts`, to the bit. whole: its search, whose parts the kernel joins."""

    whole: Search | None = None

    @staticmethod
    def of(parts: FocalParts, search: Search, refinement: PoolRefinement | AsFound) -> FocalParts:
        """These parts, joined if they can be."""
        verify: Any = search.verify
        joined = (
            isinstance(search.generator, FocalSamples)
            and isinstance(verify.score, SaturatedGains)
            and isinstance(parts.selection, FocalSelection)
            and isinstance(parts.selection.gain, SaturatedGains)
            and isinstance(refinement, PoolRefinement)
            and refinement.refine is not None
            and refinement.refine.matches is not None
            and search.degeneracy is None
            and search.hypotheses <= search.round
        )
        if not joined:
            return parts
        fields = {field.name: getattr(parts, field.name) for field in dataclasses.fields(parts)}
        return JoinedRounds(**fields, whole=search)

    def round(self, pairs: Any, turn: int, refinement: Any) -> tuple[Any, Any]:
        """As `FocalParts.round`."""
        assert self.whole is not None
        pair, start, count, most = pairs, turn * self.samples, self.whole.hypotheses, self.whole.pool
        urn = self.whole.generator.urn(pair, start, count)
        told, survivors = pair.once("round of five", lambda pair: self._told(pair, refinement))
        axes, focal, models = np.empty((most, 2, 3, 3)), np.empty((most, 2)), np.empty((most, 9))
        cost, share, posterior = np.empty((3, most))
        made = axes, focal, models, cost, share, posterior
        k = candidates_of_five(*urn, *told, start, count, survivors, *made)  # type: ignore[call-arg]
        if not k:
            return super().round(pair, turn, refinement)
        return Candidates(models[:k], posterior[:k], TwoCameras(axes[:k], focal[:k])), start + count

    def _told(self, pair: OnePair, refinement: PoolRefinement) -> tuple[tuple[Any, ...], int]:
        """What the kernel takes of a pair in every round, and the models of one that are scored on all matches."""
        assert self.whole is not None
        verify: Any = self.whole.verify
        few, near = verify.first_look(pair), refinement.which_near(pair)
        assert near is not None
        offset, _, _, *objective = prior_of(pair, self.selection.iterations)
        told = (
            *self.whole.generator.numbers(pair), CentredPair.of(pair).points, offset,
            *verify.score.first_of(few or pair), *verify.score.of(pair),
            near.limit, near.mixed_seed, near.most, pair.table, *objective, *self.selection.gain.of(pair),
        )  # fmt: skip
        return told, EVERY if few is None else verify.preselect.survivors
