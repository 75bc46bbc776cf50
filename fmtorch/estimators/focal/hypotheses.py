"""Hypotheses of cameras with plausible focal lengths: five matches each, the focal lengths drawn from their prior.

Seven matches determine F, but seven noisy ones near a plane determine it badly: the models that explain them include
many of impossible cameras. Five matches and two drawn focal lengths exclude these from the start, and are right more
often. The models are starting points: refinement finds the focal lengths (`posterior.refine_with_prior`).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Int
from torch import Tensor

from fmtorch.estimators.focal.cameras import CentredPairs, focal_scaling, translated
from fmtorch.estimators.focal.prior import draw_focal_lengths
from fmtorch.estimators.models import Models
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.geometry.arithmetic import component_sum, exponential, sqrt
from fmtorch.geometry.five_point import five_point_components
from fmtorch.geometry.orientation import consistently_oriented

CPU_SAMPLES, GPU_SAMPLES = 1 << 10, 1 << 19  # of all pairs at once: stays in the L2 cache; bounds memory

Draw = Callable[[NormalizedPairs, int, int, int], Int[Tensor, "size p count"]]
"""The matches of the draws start .. start + count - 1, `size` of each."""


class FocalSamples:
    """Models of five matches and drawn focal lengths: a generator of hypotheses for pairs of known image sizes."""

    size = 5

    def __init__(self, draw: Draw) -> None:
        self.draw = draw

    def samples_at_once(self, device: torch.device) -> int:
        """How many samples of all pairs are solved together; changes no result."""
        return GPU_SAMPLES if device.type == "cuda" else CPU_SAMPLES

    def __call__(self, pairs: NormalizedPairs, start: int, count: int) -> Models:
        """The models of the draws start .. start + count - 1, in their order."""
        samples = self.draw(pairs, start, count, self.size)
        centred = CentredPairs(pairs)
        p, s = samples.shape[1:]
        focal = draw_focal_lengths(pairs, centred.same_size, start, s)
        depth = exponential(focal) * centred.longest[..., None]
        points = torch.stack([centred.points.gather(2, i.expand(4, -1, -1)) for i in samples], 1)
        rays = (points.reshape(2, 2, self.size, p, s) / depth[:, None, None]).reshape(4, self.size, p * s)
        E, which = five_point_components(rays)
        kept = consistently_oriented(E, rays[:, :, which])
        E, which = E[:, kept], which[kept]
        F = E.reshape(3, 3, -1) * focal_scaling(depth.reshape(2, p * s)[:, which])
        pair = torch.div(which, s, rounding_mode="floor")
        F = translated(F.reshape(9, -1, 1), centred.offset[:, pair])[..., 0]
        F = F / sqrt(component_sum(F * F))
        made = torch.bincount(pair, minlength=p)
        slot = torch.arange(len(pair), device=pair.device) - (made.cumsum(0) - made)[pair]
        models = F.new_zeros(9, p, int(made.max()), dtype=torch.float32)
        models[:, pair, slot] = F.to(torch.float32)
        draw = torch.zeros_like(models[0], dtype=torch.int64)
        draw[pair, slot] = start + which - pair * s
        valid = torch.arange(models.shape[2], device=pair.device) < made[:, None]
        return Models(models, valid, draw, samples, start)
