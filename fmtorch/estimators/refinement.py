"""The models of a pool optimised and refined before one of them is selected."""

from __future__ import annotations

import dataclasses

import torch

from fmtorch.estimators.graph_cut import LocalOptimization
from fmtorch.estimators.models import Pool
from fmtorch.estimators.options import Refine
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.pool import near_models
from fmtorch.geometry.refine import RANK_TWO_ALREADY, refine_components


@dataclasses.dataclass(frozen=True)
class PoolRefinement:
    """Local optimisation of each model on its inliers, then Levenberg-Marquardt on the matches near the pool."""

    refine: Refine | None
    local_optimization: LocalOptimization | None = None

    def near(self, pool: Pool, pairs: NormalizedPairs) -> NormalizedPairs:
        """The pairs with the matches on which the pool's models are refined."""
        refine = self.refine
        return pairs if refine is None else near_models(pool.F, pairs, refine.RADIUS * refine.scale, refine.matches)

    def __call__(self, pool: Pool, pairs: NormalizedPairs) -> Pool:
        """The pool with refined models, float64."""
        F, near = pool.F.to(torch.float64), self.near(pool, pairs)
        if self.local_optimization is not None:
            F = self.local_optimization(F, pairs)
        if (refine := self.refine) is not None:
            F, _ = refine_components(
                F, near.points, near.weight, refine.kernel, refine.scale / near.scale, refine.iterations,
                squarings=RANK_TWO_ALREADY,
            )  # fmt: skip
        return dataclasses.replace(pool, F=F, near=near)


class AsFound:
    """No refinement."""

    def near(self, pool: Pool, pairs: NormalizedPairs) -> NormalizedPairs:
        """As `PoolRefinement.near`."""
        return pairs

    def __call__(self, pool: Pool, pairs: NormalizedPairs) -> Pool:
        """As `PoolRefinement`."""
        return pool
