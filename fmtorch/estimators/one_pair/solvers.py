"""`solvers` on the arrays of one pair: float64 up to the model, where tensors solve in float32."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators import solvers
from fmtorch.estimators.one_pair.models import Models
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.estimators.one_pair.sampling import Sampler
from fmtorch.geometry.eight_point_kernels import eight_point
from fmtorch.geometry.seven_point_kernels import seven_point


@runtime_checkable
class Solver(Protocol):
    """A minimal solver. size: matches of a sample. solutions: of one sample, at most."""

    size: int
    solutions: int

    def __call__(self, points: Array, sample: Array, F: Array, draw: Array) -> int:
        """Models of samples (size, s) of points (4, n) -> F (m, 9) and the sample of each; how many there are."""
        ...


class SevenPoint:
    """As `solvers.SevenPoint`."""

    size, solutions = 7, 3

    def __init__(self, part: solvers.SevenPoint) -> None:
        pass

    def __call__(self, points: Array, sample: Array, F: Array, draw: Array) -> int:
        """As `Solver`."""
        return seven_point(points, sample, F, draw)


class EightPoint:
    """As `solvers.EightPoint`."""

    size, solutions = 8, 1

    def __init__(self, part: solvers.EightPoint) -> None:
        pass

    def __call__(self, points: Array, sample: Array, F: Array, draw: Array) -> int:
        """As `Solver`."""
        return eight_point(points, sample, F, draw)


class MinimalSamples:
    """As `solvers.MinimalSamples`."""

    def __init__(self, solver: Solver, sampler: Sampler) -> None:
        self.solver, self.sampler, self.size = solver, sampler, solver.size

    def __call__(self, pair: OnePair, start: int, count: int) -> Models:
        """The models of the draws start .. start + count - 1, in their order."""
        sample = self.sampler.draw(pair, start, count, self.size)
        F = np.empty((count * self.solver.solutions, 9), np.float32)
        draw = np.empty(len(F), np.int64)
        m = self.solver(pair.points, sample, F, draw)
        return Models(F[:m], draw[:m], sample, start)
