"""From pairs to one model each by three verbs, search, refine and select, written once for both forms of the parts."""

from __future__ import annotations

import dataclasses
from typing import Any

from fmtorch.estimators.search import Confident


@dataclasses.dataclass(frozen=True)
class FocalParts:
    """The prior on focal lengths. selection: a `FocalSelection`. search: makes a pool with it; None: it only selects.

    rounds, min_rounds: of that search, of so many samples each, at most and at least; each refines candidates of its
    own. confirmations: rounds that find the best candidate of those before them again, for it to be taken. confident:
    the stopping rule for these samples, None: all rounds are made, and never suffice.
    """

    selection: Any
    search: Any = None
    samples: int = 0
    rounds: int = 1
    min_rounds: int = 1
    confirmations: int = 1
    confident: Confident | None = None

    def round(self, pairs: Any, turn: int, refinement: Any) -> tuple[Any, Any]:
        """The candidates of a round, and the samples drawn until then. refinement: says on which matches."""
        pool = self.search(pairs, turn * self.samples)
        return self.selection.of_pool(pool, pairs, refinement), pool.draws


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
        selection, best, open_ = self.plausible(self.focal, pairs)
        if not open_:
            return selection
        some = pairs.only(open_)
        other = self.select(self.refine(self.search(some), some), some, best.only(open_))
        return selection.merged(open_, other)

    def plausible(self, focal: FocalParts, pairs: Any) -> tuple[Any, Any, list[int]]:
        """The selection among plausible cameras, the candidates selected, and the pairs which these do not settle.

        Rounds go on until good candidates are one model, or enough rounds found the best of those before again, and
        the stopping rule is content. A pair is settled if that rule is content and its images have one size.
        """
        some, rows = pairs, list(range(len(pairs)))
        selection: Any = None
        best: Any = None
        candidates: Any = None
        unsettled: list[int] = []
        confirmed = [0] * len(pairs)
        for turn in range(focal.rounds):
            made, draws = focal.round(some, turn, self.refine)
            if candidates is not None:
                for row, again in zip(rows, candidates.same_best(made), strict=True):
                    confirmed[row] += again
            candidates = made if candidates is None else candidates.joined(made)
            top = candidates.best_alone()
            found = top.selection(draws)
            best = top if best is None else best.replaced(rows, top)
            selection = found if selection is None else selection.replaced(rows, found)
            enough = [False] * len(rows) if focal.confident is None else focal.confident(found.F, draws, some)
            one_model, same_size, left = candidates.unambiguous(), some.same_size, []
            for i, row in enumerate(rows):
                one = one_model[i] or confirmed[row] >= focal.confirmations
                content = turn + 1 >= focal.min_rounds and one and enough[i]
                if not content and turn + 1 < focal.rounds:
                    left.append(i)
                elif not (same_size[i] and enough[i]):
                    unsettled.append(row)
            rows = [rows[i] for i in left]
            if not rows:
                break
            some, candidates = some.only(left), candidates.only(left)
        return selection, best, sorted(unsettled)

    def select(self, pool: Any, pairs: Any, candidates: Any = None) -> Any:
        """One model of each refined pool, or of the candidates of plausible cameras."""
        if self.focal is None or not pairs.sizes_known:
            return self.selector(pool, pairs)
        return self.focal.selection.select(pool, pairs, candidates)
