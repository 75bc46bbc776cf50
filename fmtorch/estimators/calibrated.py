"""Hypotheses of cameras with plausible focal lengths: five matches each, the focal lengths drawn from their prior.

Seven matches determine F, but seven noisy ones near a plane determine it badly: the models that explain them include
many of impossible cameras. Five matches and two drawn focal lengths exclude these from the start, and are right more
often. The models are starting points: refinement finds the focal lengths (`focal.refine_focal`).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch import random
from fmtorch.estimators.focal import (
    FOCAL_DEVIATION,
    RATIO_DEVIATION,
    USUAL_FOCAL,
    Cameras,
    scales,
    translated,
)
from fmtorch.estimators.problem import Problem
from fmtorch.geometry.arithmetic import component_sum, exponential
from fmtorch.geometry.five_point import five_point_components
from fmtorch.geometry.orientation import consistently_oriented
from fmtorch.random import Stream

SAMPLE = 5
SAME_FOCAL = 0.7  # share of the draws for images of equal size that have one focal length for both
_BITS = 10
_NORMAL = torch.special.ndtri((torch.arange(1 << _BITS, dtype=torch.float64) + 0.5) / (1 << _BITS))


def draw_focal_lengths(problem: Problem, cameras: Cameras, start: int, count: int) -> Float[Tensor, "2 p s"]:
    """Log focal lengths of both images for the draws start .. start + count - 1, in units of the longer image side."""
    bits = random.bits(problem.seed, problem.key, Stream.FOCAL, start, count, 3) & ((1 << _BITS) - 1)
    normal = _NORMAL.to(bits.device)
    mean = math.log(USUAL_FOCAL) + FOCAL_DEVIATION * normal[bits[..., 0]]
    half = RATIO_DEVIATION / 2 * normal[bits[..., 1]]
    equal = cameras.same_size[:, None] & (bits[..., 2] < SAME_FOCAL * (1 << _BITS))
    half = torch.where(equal, 0.0, half)
    return torch.stack([mean + half, mean - half])


def calibrated_hypotheses(
    problem: Problem, index: Int[Tensor, "five p s"], start: int
) -> tuple[Float[Tensor, "9 p m"], Bool[Tensor, "p m"]]:
    """Models of five matches each, for the points of the problem, float32, and which slots hold one.

    index: the matches of the draws start .. start + s - 1. Models stand in the order of the draws. The sizes of the
    images must be known.
    """
    cameras = Cameras(problem)
    p, s = index.shape[1:]
    depth = exponential(draw_focal_lengths(problem, cameras, start, s)) * cameras.longest[..., None]
    points = torch.stack([cameras.points.gather(2, i.expand(4, -1, -1)) for i in index], 1)
    rays = (points.reshape(2, 2, SAMPLE, p, s) / depth[:, None, None]).reshape(4, SAMPLE, p * s)
    E, sample = five_point_components(rays)
    kept = consistently_oriented(E, rays[:, :, sample])
    E, sample = E[:, kept], sample[kept]
    F = E.reshape(3, 3, -1) * scales(depth.reshape(2, p * s)[:, sample])
    pair = torch.div(sample, s, rounding_mode="floor")
    F = translated(F.reshape(9, -1, 1), cameras.offset[:, pair])[..., 0]
    F = F / component_sum(F * F).sqrt()
    count = torch.bincount(pair, minlength=p)
    slot = torch.arange(len(pair), device=pair.device) - (count.cumsum(0) - count)[pair]
    models = F.new_zeros(9, p, int(count.max()), dtype=torch.float32)
    models[:, pair, slot] = F.to(torch.float32)
    return models, torch.arange(models.shape[2], device=pair.device) < count[:, None]
