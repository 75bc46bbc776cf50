"""Minimal solvers, and the generator of hypotheses that draws samples for them; the mathematics is in `geometry`."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.estimators.models import Models
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.sampling import Sampler
from fmtorch.geometry.minimal import eight_point_components, seven_point_components
from fmtorch.geometry.orientation import consistently_oriented

CPU_SAMPLES, GPU_SAMPLES = 1 << 14, 1 << 21  # minimal samples that are solved together: bounds memory


@runtime_checkable
class Solver(Protocol):
    """A minimal solver: `size` matches in, up to a few models out, always in as many slots a sample."""

    size: int

    def __call__(self, sample: Float[Tensor, "4 size p s"]) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"]]:
        """Models and which of them exist, in the order of the samples."""
        ...


class SevenPoint:
    """Up to three models from seven matches."""

    size = 7

    def __call__(self, sample: Float[Tensor, "4 size p s"]) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"]]:
        """As `Solver`: the three roots of one sample stand together."""
        F, valid = seven_point_components(sample)
        valid = valid & consistently_oriented(F, sample[:, :, None])
        return F.permute(0, 2, 3, 1).flatten(2).contiguous(), valid.permute(1, 2, 0).flatten(1).contiguous()


class EightPoint:
    """One model from eight matches."""

    size = 8

    def __call__(self, sample: Float[Tensor, "4 size p s"]) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"]]:
        """As `Solver`."""
        F, valid = eight_point_components(sample)
        return F, valid & consistently_oriented(F, sample)


class MinimalSamples:
    """Draws minimal samples and solves them: a `Generator`."""

    def __init__(self, solver: Solver, sampler: Sampler) -> None:
        self.solver, self.sampler, self.size = solver, sampler, solver.size

    def samples_at_once(self, device: torch.device) -> int:
        """As `Generator.samples_at_once`."""
        return GPU_SAMPLES if device.type == "cuda" else CPU_SAMPLES

    def __call__(self, pairs: NormalizedPairs, start: int, count: int) -> Models:
        """As `Generator`."""
        samples = self.sampler.draw(pairs, start, count, self.size)
        F, valid = self.solver(torch.stack([pairs.points32.gather(2, i.expand(4, -1, -1)) for i in samples], 1))
        slots = valid.shape[1] // count
        draw = torch.arange(start, start + count, device=valid.device).repeat_interleave(slots)
        return Models(F, valid, draw.expand_as(valid), samples, start)
