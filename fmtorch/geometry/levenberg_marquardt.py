"""Levenberg-Marquardt: the one loop of all non-linear fits, over many models at once.

Damped Gauss-Newton steps; each model takes its own where that lowers its cost, and else tries a shorter one (Marquardt
1963; Hartley & Zisserman 2004, appendix 6.2). The loop holds no arithmetic: the objective supplies it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

State = TypeVar("State")
Parameters = TypeVar("Parameters")


@runtime_checkable
class Objective(Protocol[State, Parameters]):
    """What is minimised: costs with their derivatives, steps, and which of them to take.

    tolerance: None, or what ends the fit of a model; it then keeps the derivatives at its end.
    """

    tolerance: float | None

    def evaluate(self, parameters: Parameters, derivatives: bool) -> State:
        """The cost of all models at these parameters, and the normal equations there if asked for."""
        ...

    def begin(self, state: State) -> tuple[Any, Any]:
        """The first damping of each model, and that none is done."""
        ...

    def step(self, state: State, damping: Any) -> Parameters:
        """The parameters after one damped step."""
        ...

    def accept(self, state: State, trial: State, damping: Any, done: Any) -> tuple[State, Any, Any]:
        """The trial for the models that it improves, the next damping, and which models are done."""
        ...


def levenberg_marquardt(objective: Objective[State, Parameters], start: Parameters, iterations: int) -> State:
    """The state of least cost after at most so many steps; no cost ever rises above that of the start."""
    at_end = objective.tolerance is not None
    state = objective.evaluate(start, iterations > 0 or at_end)
    damping, done = objective.begin(state)
    for i in range(iterations):
        trial = objective.evaluate(objective.step(state, damping), i + 1 < iterations or at_end)
        state, damping, done = objective.accept(state, trial, damping, done)
        if objective.tolerance is not None and bool(done.all()):
            break
    return state


class Damping(NamedTuple):
    """The first damping of a fit, relative to the curvature, and its bounds; a step divides or multiplies it by 10."""

    first: float
    least: float
    most: float


@dataclasses.dataclass(frozen=True, eq=False)
class TensorState:
    """Tensors whose last axes are pairs and models; derivatives are empty where they were not asked for."""

    cost: Float[Tensor, "p k"]

    def replaced(self: Self_, other: Self_, condition: Bool[Tensor, "p k"]) -> Self_:
        """The other state where the condition holds, without derivatives if the other has none."""
        merged = {}
        for field in dataclasses.fields(self):
            mine, new = getattr(self, field.name), getattr(other, field.name)
            merged[field.name] = torch.where(condition, new, mine) if len(new) else mine
        return dataclasses.replace(self, **merged)


Self_ = TypeVar("Self_", bound=TensorState)


class TensorObjective(Generic[Self_]):
    """The part of an objective that is the same for all whose state is a `TensorState`."""

    damping: Damping
    tolerance: float | None = None

    def negligible(self, decrease: Tensor, state: Self_) -> Bool[Tensor, "p k"]:
        """Which models are done, by how much an accepted step lowered their cost."""
        raise NotImplementedError

    def begin(self, state: Self_) -> tuple[Tensor, Tensor]:
        """As `Objective.begin`."""
        return torch.full_like(state.cost, self.damping.first), torch.zeros_like(state.cost, dtype=torch.bool)

    def accept(self, state: Self_, trial: Self_, damping: Tensor, done: Tensor) -> tuple[Self_, Tensor, Tensor]:
        """As `Objective.accept`."""
        better = (trial.cost < state.cost) & ~done
        damping = torch.where(better, damping / 10, damping * 10).clamp_(self.damping.least, self.damping.most)
        if self.tolerance is not None:
            done = done | (better & self.negligible(state.cost - trial.cost, state))  # a rejected step ends no fit
        return state.replaced(trial, better), damping, done
