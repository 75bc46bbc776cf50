"""NSGD exactly as the released FM-Bench evaluator computes it, faults included, to compare with published figures.

What differs from `nsgd` (github.com/JiawangBian/FM-Bench, ComputeNormlizedSGD.m):

- the sum over accepted draws is divided by `samples`, however few were accepted among ten times as many tries: an
  estimate whose lines never meet the image gets 0, perfect;
- the second half exchanges the image sizes together with the matrices, without transposing them;
- the point on a line is y = -(a x + c) / b: one exactly vertical line among the draws makes the figure 1;
- virtual points are rounded to whole pixels 0 .. w, 0 .. h, and image borders lie at 0.5 and size + 0.5;
- 1e-10 is added to the length of a line's normal, so the figure depends on the scale of very small matrices.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import checked
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.metrics.nsgd import Chord, Draws, Pairs, diagonal, from_centre, lines, sum_of_draws

BORDER = 0.5  # left and top edge of the first pixel where pixels count from 1
NORMAL_OFFSET = 1e-10


@checked
@torch.no_grad()
def nsgd_released(
    F_gt: Float[Tensor, "*#batch 3 3"],
    F_est: Float[Tensor, "*#batch 3 3"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    samples: int = 1000,
    seed: int = 0,
    key: Int[Tensor, "*#batch"] | None = None,
) -> Float[Tensor, "*#batch"]:
    """NSGD in image diagonals with the released evaluator's faults (see the module); arguments as `nsgd`.

    The matrices are used as they are given, in pixels from 0 or from 1. A failed estimate, zero or not finite, gets 1:
    the evaluator never measures those and counts them as misses. Not differentiable; `nsgd` is.
    """
    pairs, shape = Pairs.flatten(F_gt, F_est, size0, size1, key)
    total, _ = sum_of_draws(pairs, released_draw, samples=samples, seed=seed)
    value = (total / samples).clamp(max=1.0)
    failed = ~pairs.F_est.isfinite().all(-1).all(-1) | (pairs.F_est == 0).all(-1).all(-1)
    return torch.where(failed | value.isnan(), 1.0, value).reshape(shape).to(F_est.dtype)


def released_draw(pairs: Pairs, draws: Draws) -> tuple[Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """The value of each draw in image diagonals (NaN or infinite on vertical lines), and whether it counts."""
    size0 = torch.stack([pairs.size0, pairs.size1])
    size1, both = size0.flip(0), torch.stack([pairs.F_gt, pairs.F_est])
    F, other = from_centre(both, size1, BORDER), from_centre(both.flip(0), size1, BORDER)
    h, w = size0[:, :, None].unbind(-1)
    x0, y0 = (draws.x * w).round(), (draws.y * h).round()
    a, b, c = lines(F, x0, y0)
    chord = Chord.of([a, b, c], size1)
    x1, _ = chord.at(draws.share)
    y1 = -(a * x1 + c) / b
    d1 = _distance(x1, y1, *lines(other, x0, y0)) / diagonal(size1)[..., None]
    d0 = _distance(x0, y0, *lines(other.mT, x1, y1)) / diagonal(size0)[..., None]
    mean = (d0 + d1) / 2
    return (mean[0] + mean[1]) / 2, chord.hits.all(0)


def _distance(x: Tensor, y: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return (a * x + b * y + c).abs() / (sqrt(torch.addcmul(a * a, b, b)) + NORMAL_OFFSET)
