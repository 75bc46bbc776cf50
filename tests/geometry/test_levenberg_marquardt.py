"""The loop of all non-linear fits, on a problem of known solution."""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from torch import Tensor

from fmtorch.geometry.levenberg_marquardt import Damping, TensorObjective, TensorState, levenberg_marquardt


@dataclasses.dataclass(frozen=True, eq=False)
class _State(TensorState):
    x: Tensor
    slope: Tensor
    curvature: Tensor


class _Valley(TensorObjective[_State]):
    """The cost ``(x^2 - 1)^2``, one number for each of (p, k) models; log: the costs of all trials."""

    damping = Damping(1e-3, 1e-9, 1e6)

    def __init__(self, tolerance: float | None = None) -> None:
        self.tolerance, self.log = tolerance, []  # type: ignore[var-annotated]

    def evaluate(self, parameters: Tensor, derivatives: bool) -> _State:
        x = parameters
        e = x * x - 1
        self.log.append((e * e, derivatives))
        slope, curvature = (2 * x * e)[None], (4 * x * x)[None]
        return _State(e * e, x, slope if derivatives else slope[:0], curvature if derivatives else curvature[:0])

    def step(self, state: _State, damping: Tensor) -> Tensor:
        return state.x - state.slope[0] / (state.curvature[0] * (1 + damping))

    def negligible(self, decrease: Tensor, state: _State) -> Tensor:
        return decrease <= self.tolerance


START = torch.tensor([[3.0, 1e-3, -2.0]], dtype=torch.float64)


def test_reaches_the_minima_and_no_cost_rises() -> None:
    valley = _Valley()
    end = levenberg_marquardt(valley, START, 40)
    torch.testing.assert_close(end.x.abs(), torch.ones(1, 3, dtype=torch.float64), rtol=0, atol=1e-9)
    costs = [levenberg_marquardt(_Valley(), START, i).cost for i in range(12)]
    assert all(bool((later <= earlier).all()) for earlier, later in itertools.pairwise(costs))


def test_rejected_steps_are_made_again_with_more_damping() -> None:
    """From 0.001 a Gauss-Newton step leaps to 500, where the cost is larger; the fit must come back from there."""
    valley = _Valley()
    levenberg_marquardt(valley, START, 3)
    leap = valley.log[1][0][0, 1]
    assert float(leap) > 1e9
    assert float(levenberg_marquardt(_Valley(), START, 40).cost[0, 1]) < 1e-18


def test_a_rejected_step_ends_no_fit() -> None:
    """The first step from 0.001 raises the cost: that is no sign that the fit has converged."""
    end = levenberg_marquardt(_Valley(1e-9), START[:, 1:2], 40)
    assert float(end.cost) < 1e-6


@pytest.mark.parametrize("iterations", [0, 1, 4])
def test_derivatives_are_computed_where_they_are_needed(iterations: int) -> None:
    plain, ending = _Valley(), _Valley(-torch.inf)
    levenberg_marquardt(plain, START, iterations)
    assert [asked for _, asked in plain.log] == [*[True] * iterations, False]
    assert len(levenberg_marquardt(ending, START, iterations).slope) == 1
    assert all(asked for _, asked in ending.log)


def test_a_fit_ends_where_nothing_is_gained() -> None:
    valley = _Valley(1e-6)
    end = levenberg_marquardt(valley, torch.full((1, 3), 1.5, dtype=torch.float64), 100)
    assert len(valley.log) < 20
    assert float(end.cost.max()) < 1e-6


def test_neighbours_are_invisible() -> None:
    together = levenberg_marquardt(_Valley(1e-6), START, 10)
    for k in range(3):
        assert torch.equal(levenberg_marquardt(_Valley(1e-6), START[:, k : k + 1], 10).x[:, 0], together.x[:, k])
