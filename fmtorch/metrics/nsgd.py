"""Symmetric geometry distance between two fundamental matrices, in pixels (SGD) and in image diagonals (NSGD).

Zhang's procedure (Determining the epipolar geometry and its uncertainty: a review, IJCV 1998, section 5.2), normalised
after Bian et al. (An evaluation of feature matchers for fundamental matrix estimation, BMVC 2019, Algorithm 1):

1. draw a point m uniformly in image 0, and m' uniformly on the part of its line F_gt m that lies inside image 1;
2. d1' = distance of m' to F_est m in image 1, d1 = distance of m to F_est^T m' in image 0;
3. the same with the roles of the two matrices exchanged (points still in image 0, lines in image 1) and a new m.

A draw is accepted when both lines meet image 1; the figure is the mean of the four distances over accepted draws.
It is not symmetric under exchanging the images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.compiling.arrays import Array
from fmtorch.compiling.batches import for_each_pair, kernels_serve
from fmtorch.core.checks import checked
from fmtorch.core.streams import Stream, mixed_seed
from fmtorch.geometry.arithmetic import sqrt
from fmtorch.geometry.epipolar import lines_through, residual_and_normals, unit_largest
from fmtorch.metrics import nsgd_kernels as compiled
from fmtorch.metrics.draws import Pairs, diagonal, expect_samples, segment_in_image, sum_of_draws

BORDER = -0.5  # left and top edge of the first pixel
NORMAL_FLOOR = 1e-12  # length of a normal, for F of unit size, that is as good as none: its line is at infinity


@checked
def sgd(
    F_gt: Float[Tensor, "*#batch 3 3"],
    F_est: Float[Tensor, "*#batch 3 3"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    samples: int = 1000,
    seed: int = 0,
    key: Int[Tensor, "*#batch"] | None = None,
    cap: bool = True,
) -> Float[Tensor, "*#batch"]:
    """Symmetric geometry distance in pixels, at most the mean of the two image diagonals; otherwise as `nsgd`.

    Args:
        F_gt: true fundamental matrices (..., 3, 3), of any scale and sign.
        F_est: estimated ones.
        size0: sizes (..., 2) of image 0 as (h, w).
        size1: those of image 1.
        samples: accepted draws.
        seed: of the draws.
        key: (...), the pairs' keys.
        cap: whether the value has that limit.

    Returns:
        (...).
    """
    return _mean_distance(torch.ones_like, F_gt, F_est, size0, size1, samples, seed, key, cap)


@checked
def nsgd(
    F_gt: Float[Tensor, "*#batch 3 3"],
    F_est: Float[Tensor, "*#batch 3 3"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    samples: int = 1000,
    seed: int = 0,
    key: Int[Tensor, "*#batch"] | None = None,
    cap: bool = True,
) -> Float[Tensor, "*#batch"]:
    """Normalised symmetric geometry distance: each distance divided by the diagonal of the image it is measured in.

    The value is 1 where no draw is accepted, and where a matrix is zero or not finite.

    Args:
        F_gt: true fundamental matrices (..., 3, 3), of any scale and sign.
        F_est: estimated ones.
        size0: sizes (..., 2) of image 0 as (h, w).
        size1: those of image 1.
        samples: accepted draws, of at most ten times as many tries.
        seed: of the draws.
        key: (...), the pairs' keys, which select their random points; with the same key and seed the points are the
            same.
        cap: limit the mean to 1. Without it the value is a loss, differentiable with respect to both matrices and
            unbounded.

    Returns:
        (...), at least 0.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import nsgd
        >>> rows = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a sideways camera
        >>> columns = torch.tensor([[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]])  # one that moves up
        >>> size = torch.tensor([480, 640])
        >>> round(nsgd(rows, 5 * rows, size, size).item(), 6), bool(nsgd(rows, columns, size, size) > 0.05)
        (0.0, True)
    """
    return _mean_distance(torch.clone, F_gt, F_est, size0, size1, samples, seed, key, cap)


def draw_distances(
    pairs: Pairs, uniforms: Float[Tensor, "b n 6"]
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """Of each draw the mean distances in pixels in images 0 and 1 over its two halves, and whether it counts."""
    first, second = uniforms[..., :3], uniforms[..., 3:]
    a0, a1, hits_a = _half_draw(pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1, first)
    b0, b1, hits_b = _half_draw(pairs.F_est, pairs.F_gt, pairs.size0, pairs.size1, second)
    return (a0 + b0) / 2, (a1 + b1) / 2, hits_a & hits_b


def _half_draw(
    F: Tensor, F_other: Tensor, size0: Tensor, size1: Tensor, uniforms: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Steps 1 and 2: a match (m, m') exact for F, and its distances from the lines of F_other in images 0 and 1."""
    m = uniforms[..., :2] * size0.flip(-1)[:, None] + BORDER
    start, end, hits = segment_in_image(lines_through(F, m), size1, BORDER)
    m_prime = start + uniforms[..., 2:] * (end - start)
    e, squared0, squared1 = residual_and_normals(F_other, m, m_prime)
    floor = NORMAL_FLOOR**2
    return e.abs() / sqrt(squared0 + floor), e.abs() / sqrt(squared1 + floor), hits


def _mean_distance(
    unit: Callable[[Tensor], Tensor],
    F_gt: Tensor,
    F_est: Tensor,
    size0: Tensor,
    size1: Tensor,
    samples: int,
    seed: int,
    key: Tensor | None,
    cap: bool,
) -> Tensor:
    """Mean over accepted draws; `unit` makes of an image's diagonal the length its distances are divided by."""
    pairs, shape = Pairs.flatten(F_gt, F_est, size0, size1, key)
    valid = pairs.F_gt.isfinite().all(-1).all(-1) & pairs.F_est.isfinite().all(-1).all(-1)
    scaled = [unit_largest(torch.where(valid[:, None, None], F, 0.0)) for F in (pairs.F_gt, pairs.F_est)]
    pairs = replace(pairs, F_gt=scaled[0], F_est=scaled[1])

    def draw(tile: Pairs, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        d0, d1, accepted = draw_distances(tile, uniforms)
        unit0, unit1 = unit(diagonal(tile.size0)), unit(diagonal(tile.size1))
        return (d0 / unit0[:, None] + d1 / unit1[:, None]) / 2, accepted

    if kernels_serve(pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1):
        total, count = compiled_sums(unit, pairs, samples, seed)
    else:
        total, count = sum_of_draws(pairs, draw, samples=samples, seed=seed)
    diagonal0, diagonal1 = diagonal(pairs.size0), diagonal(pairs.size1)
    worst = (diagonal0 / unit(diagonal0) + diagonal1 / unit(diagonal1)) / 2
    value = torch.where(count > 0, total / count.clamp(min=1), worst)
    return (torch.minimum(value, worst) if cap else value).reshape(shape).to(F_est.dtype)


def compiled_sums(
    unit: Callable[[Tensor], Tensor], pairs: Pairs, samples: int, seed: int, released: bool = False
) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
    """Sum and number of the accepted draws of each pair, by the kernel. released: draws of `nsgd_released`."""
    expect_samples(samples)
    units = torch.stack([unit(diagonal(size)) for size in (pairs.size0, pairs.size1)], -1)
    tensors = (pairs.F_gt, pairs.F_est, pairs.size0, pairs.size1, units, pairs.key[:, None])
    constants = (released, mixed_seed(seed, Stream.METRIC), samples)
    out = torch.empty(len(units), 2, dtype=torch.float64)
    terms = for_each_pair(_into, tensors, *constants, out=out, kind=torch.float64)
    return terms[:, 0], terms[:, 1]


def _into(
    F_gt: Array, F_est: Array, size0: Array, size1: Array, unit: Array, key: Array, released: bool, seed: int,
    samples: int, out: Array,
) -> None:  # fmt: skip
    compiled.accepted_draws(
        compiled.Comparison(F_gt, F_est, size0, size1, unit, released), int(key[0]), seed, samples, out
    )
