"""From pairs to one model each by three verbs, search, refine and select, written once for both forms of the parts."""

from __future__ import annotations

import dataclasses
from typing import Any

from fmtorch.estimators.search import Confident


@dataclasses.dataclass(frozen=True)
class FocalParts:
    """The prior on focal lengths. selection: a `FocalSelection`. search: makes a pool with it; None: it only selects.

    confident: the stopping rule for that search, None: it never suffices.
    """

    selection: Any
    search: Any = None
    confident: Confident | None = None


@dataclasses.dataclass(frozen=True)
class Verbs:
    """Parts of one form. search: a `Search`. refine: a `PoolRefinement`. selector: takes one model of each pool."""

    search: Any
    refine: Any
    selector: Any
    focal: FocalParts | None = None

    def __call__(self, pairs: Any) -> Any:
        """The selection: with plausible cameras first where the image sizes are known."""
        if self.focal is None or self.focal.search is None or not pairs.sizes_known:
            return self.select(self.refine(self.search(pairs), pairs), pairs)
        pool, confident = self.focal.search(pairs), self.focal.confident
        candidates = self.focal.selection.refined(pool.models, pool.valid, pairs, self.refine.near(pool, pairs))
        selection = candidates.selection(pool.draws)
        decided = candidates.decided(pairs)
        enough = [False] * len(pairs) if confident is None else confident(selection.F, pool.draws, pairs)
        open_ = [i for i, (one, other) in enumerate(zip(decided, enough, strict=True)) if not (one and other)]
        if not open_:
            return selection
        some = pairs.only(open_)
        other = self.select(self.refine(self.search(some), some), some, candidates.only(open_))
        return selection.merged(open_, other)

    def select(self, pool: Any, pairs: Any, candidates: Any = None) -> Any:
        """One model of each refined pool, or of the candidates of plausible cameras."""
        if self.focal is None or not pairs.sizes_known:
            return self.selector(pool, pairs)
        return self.focal.selection.select(pool, pairs, candidates)
