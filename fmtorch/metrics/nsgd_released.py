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
from jaxtyping import Float, Int, Real
from torch import Tensor

from fmtorch.core.checks import checked
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.geometry.epipolar import lines_through
from fmtorch.jit.batches import kernels_serve
from fmtorch.metrics.nsgd import Pairs, compiled_sums, diagonal, segment_in_image, sum_of_draws

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
    if kernels_serve(pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1):
        total, _ = compiled_sums(torch.clone, pairs, samples, seed, released=True)
    else:
        total, _ = sum_of_draws(pairs, released_draw, samples=samples, seed=seed)
    value = (total / samples).clamp(max=1.0)
    failed = ~pairs.F_est.isfinite().all(-1).all(-1) | (pairs.F_est == 0).all(-1).all(-1)
    return torch.where(failed | value.isnan(), 1.0, value).reshape(shape).to(F_est.dtype)


def released_draw(pairs: Pairs, uniforms: Float[Tensor, "b n 6"]) -> tuple[Tensor, Tensor]:
    """The value of each draw in image diagonals (NaN or infinite on vertical lines), and whether it counts."""
    first, second = uniforms[..., :3], uniforms[..., 3:]
    a, hits_a = _half_draw(pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1, first)
    b, hits_b = _half_draw(pairs.F_est, pairs.F_gt, pairs.size1, pairs.size0, second)
    return (a + b) / 2, hits_a & hits_b


def _half_draw(F: Tensor, F_other: Tensor, size0: Tensor, size1: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
    """A match on F and the mean of its distances from the lines of F_other, in the diagonals of the images."""
    m = (uniforms[..., :2] * size0.flip(-1)[:, None]).round()
    a, b, c = lines_through(F, m)
    start, end, hits = segment_in_image([a, b, c], size1, BORDER)
    x = start[..., 0] + uniforms[..., 2] * (end - start)[..., 0]
    m_prime = torch.stack([x, -(a * x + c) / b], -1)
    d1 = _distance(m_prime, lines_through(F_other, m)) / diagonal(size1)[:, None]
    d0 = _distance(m, lines_through(F_other.mT, m_prime)) / diagonal(size0)[:, None]
    return (d0 + d1) / 2, hits


def _distance(x: Tensor, line: list[Tensor]) -> Tensor:
    a, b, c = line
    return (a * x[..., 0] + b * x[..., 1] + c).abs() / (sqrt(a * a + b * b) + NORMAL_OFFSET)
