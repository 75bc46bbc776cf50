"""`refinement` on the arrays of one pair: the models of a pool refined before one of them is selected."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from fmtorch.core.random import Stream, mixed_seed
from fmtorch.estimators.one_pair.graph_cut import LocalOptimization
from fmtorch.estimators.one_pair.models import Pool
from fmtorch.estimators.one_pair.pair import Array, OnePair, squared
from fmtorch.estimators.one_pair.refine import refine_models
from fmtorch.estimators.options import Refine
from fmtorch.estimators.pool_kernels import near
from fmtorch.geometry.refine import RANK_TWO_ALREADY


class Near(NamedTuple):
    """As `pool.near_models`: at most so many matches within a squared Sampson distance, in the unit of the points."""

    limit: np.float32
    mixed_seed: int
    key: int
    most: int

    @staticmethod
    def of(pair: OnePair, radius: float, most: int | None) -> Near | None:
        """Of a pair. radius: in pixels. None: all matches."""
        if most is None:
            return None
        limit = np.float32(squared(radius / pair.pixels_per_unit))
        return Near(limit, mixed_seed(pair.seed, Stream.REFINEMENT), pair.key, most)


class PoolRefinement:
    """As `refinement.PoolRefinement`."""

    def __init__(self, refine: Refine | None, local_optimization: LocalOptimization | None = None) -> None:
        self.refine, self.local_optimization = refine, local_optimization

    def which_near(self, pair: OnePair) -> Near | None:
        """Which matches near models these are refined on; None: all."""
        refine = self.refine
        return None if refine is None else Near.of(pair, refine.RADIUS * refine.scale, refine.matches)

    def near(self, pool: Pool, pair: OnePair) -> OnePair:
        """As `refinement.PoolRefinement.near`."""
        return near_models(pool.F[: pool.filled], pair, self.which_near(pair))

    def __call__(self, pool: Pool, pair: OnePair) -> Pool:
        """As `refinement.PoolRefinement`."""
        F, near = pool.models, self.near(pool, pair)
        if self.local_optimization is not None:
            F = self.local_optimization(F, pair)
        if (refine := self.refine) is not None:
            F = refine_models(F, near, refine.kernel, refine.scale, refine.iterations, RANK_TWO_ALREADY)
        return dataclasses.replace(pool, F=F, near=near)


class AsFound:
    """As `refinement.AsFound`."""

    def which_near(self, pair: OnePair) -> Near | None:
        """As `PoolRefinement.which_near`."""
        return None

    def near(self, pool: Pool, pair: OnePair) -> OnePair:
        """As `PoolRefinement.near`."""
        return pair

    def __call__(self, pool: Pool, pair: OnePair) -> Pool:
        """As `PoolRefinement`."""
        return pool


def near_models(F: Array, pair: OnePair, which: Near | None) -> OnePair:
    """As `pool.near_models` of models (k, 9), float32."""
    if which is None:
        return pair
    index = np.empty(min(which.most, pair.count), np.int64)
    return pair.take(index[: near(F, pair.points32, which.limit, which.mixed_seed, which.key, index)])
