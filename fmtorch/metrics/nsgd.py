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

from fmtorch.core.checks import checked
from fmtorch.geometry.epipolar import unit_largest
from fmtorch.metrics.draws import Chord, Draws, Pairs, diagonal, from_centre, lines, sum_of_draws

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
    pairs: Pairs, draws: Draws
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """Of each draw the mean distances in pixels in images 0 and 1 over its two halves, and whether it counts.

    A half is steps 1 and 2: a match (m, m') exact for one matrix, and its distances from the lines of the other.
    """
    F = from_centre(torch.stack([pairs.F_gt, pairs.F_est]), pairs.size1, BORDER)
    h, w = pairs.size0[..., None].unbind(-2)
    x, y, z = F.unbind(-1)
    of_shares = torch.stack([x * w, y * h, z + BORDER * (x + y)], -1)  # of shares of the sides of image 0
    x1, y1 = (chord := Chord.of(*lines(of_shares, draws.x, draws.y), pairs.size1)).at(draws.share)
    a1, b1, c1 = lines(of_shares.flip(0), draws.x, draws.y)
    a0, b0 = lines(F.flip(0).mT[..., :2, :], x1, y1)
    e = torch.addcmul(torch.addcmul(c1, a1, x1), b1, y1).abs()
    d0, d1 = (e * (torch.addcmul(a * a, b, b) + NORMAL_FLOOR**2).rsqrt() for a, b in ((a0, b0), (a1, b1)))
    return (d0[0] + d0[1]) / 2, (d1[0] + d1[1]) / 2, chord.hits.all(0)


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

    def draw(tile: Pairs, draws: Draws) -> tuple[Tensor, Tensor]:
        d0, d1, accepted = draw_distances(tile, draws)
        unit0, unit1 = unit(diagonal(tile.size0)), unit(diagonal(tile.size1))
        return (d0 / unit0[:, None] + d1 / unit1[:, None]) / 2, accepted

    total, count = sum_of_draws(pairs, draw, samples=samples, seed=seed)
    diagonal0, diagonal1 = diagonal(pairs.size0), diagonal(pairs.size1)
    worst = (diagonal0 / unit(diagonal0) + diagonal1 / unit(diagonal1)) / 2
    value = torch.where(count > 0, total / count.clamp(min=1), worst)
    return (torch.minimum(value, worst) if cap else value).reshape(shape).to(F_est.dtype)
