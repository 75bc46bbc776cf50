"""`solvers` on the arrays of one pair: float64 up to the model, where tensors solve in float32."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators import solvers
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.sampling import Sampler, Urn, seed_of
from fmtorch.estimators.solvers_kernels import samples_of_eight, samples_of_seven


@runtime_checkable
class Solver(Protocol):
    """A minimal solver. size: matches of a sample. solutions: of one sample, at most."""

    size: int
    solutions: int

    def __call__(
        self, urn: Urn, seed: int, key: int, start: int, points: Array, sample: Array, F: Array, draw: Array
    ) -> int:
        """Draws from an urn and solves: as `solvers_kernels`."""
        ...


class SevenPoint:
    """As `solvers.SevenPoint`."""

    size, solutions = 7, 3

    def __init__(self, part: solvers.SevenPoint) -> None:
        pass

    def __call__(
        self, urn: Urn, seed: int, key: int, start: int, points: Array, sample: Array, F: Array, draw: Array
    ) -> int:
        """As `Solver`."""
        return samples_of_seven(*urn, seed, key, start, points, sample, F, draw)


class EightPoint:
    """As `solvers.EightPoint`."""

    size, solutions = 8, 1

    def __init__(self, part: solvers.EightPoint) -> None:
        pass

    def __call__(
        self, urn: Urn, seed: int, key: int, start: int, points: Array, sample: Array, F: Array, draw: Array
    ) -> int:
        """As `Solver`."""
        return samples_of_eight(*urn, seed, key, start, points, sample, F, draw)


class MinimalSamples:
    """As `solvers.MinimalSamples`."""

    def __init__(self, solver: Solver, sampler: Sampler) -> None:
        self.solver, self.sampler, self.size = solver, sampler, solver.size

    def __call__(self, pair: OnePair, start: int, count: int) -> Models:
        """The models of the draws start .. start + count - 1, in their order."""
        urn, sample = self.sampler.urn(pair, start, count, self.size), np.empty((self.size, count), np.int64)
        F = np.empty((count * self.solver.solutions, 9), np.float32)
        draw = np.empty(len(F), np.int64)
        m = self.solver(urn, seed_of(pair), pair.key, start, pair.points, sample, F, draw)
        return Models(F[:m], draw[:m], sample, start)
