"""Virtual correspondences of a known two-view geometry, on which estimates of it are judged in training."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.geometry.epipolar import lines_through, unit_largest
from fmtorch.jit.random import Stream, uniform
from fmtorch.metrics.nsgd import BORDER, segment_in_image

TRIES = 4  # draws made for each point wanted; those whose epipolar line misses image 1 are dropped


class VirtualPoints(NamedTuple):
    """Exact correspondences in pixels; slots where `mask` is False hold (0, 0)."""

    x0: Float[Tensor, "b n 2"]
    x1: Float[Tensor, "b n 2"]
    mask: Bool[Tensor, "b n"]


def virtual_points(
    F: Float[Tensor, "b 3 3"],
    size0: Real[Tensor, "b 2"],
    size1: Real[Tensor, "b 2"],
    *,
    count: int = 256,
    seed: int = 0,
    key: Int[Tensor, " b"] | None = None,
) -> VirtualPoints:
    """Points of image 0 and, on their epipolar lines, points of image 1, each inside its image; without gradients.

    A point is drawn uniformly in image 0, its partner uniformly on the part of its line inside image 1, as NSGD draws
    them (see `fmtorch.metrics.nsgd`). Published losses move a regular grid onto the geometry instead (Ranftl & Koltun,
    ECCV 2018, section 3.3; Zhang et al., OANet, ICCV 2019), which puts some of the points outside the images.

    Args:
        F: true fundamental matrices in pixels, of any scale.
        size0: image sizes as (h, w), pixels.
        size1: likewise, of image 1.
        count: points for each pair.
        seed: of the draws, a function of (seed, key).
        key: the pairs' keys; 0 for all where None.

    Returns:
        `count` slots for each pair. There are fewer points where fewer than one in TRIES lines meets image 1, and none
        where F is zero or not finite.

    Raises:
        ValueError: count is less than 1.
    """
    if count < 1:
        raise ValueError(f"count is {count}; it must be at least 1")
    with torch.no_grad():
        F = F.to(torch.float64)
        valid = F.isfinite().all(-1).all(-1)
        F = unit_largest(torch.where(valid[:, None, None], F, 0.0))
        height0, width0 = size0.to(torch.float64)[:, None].unbind(-1)
        key = torch.zeros(len(F), dtype=torch.int64, device=F.device) if key is None else key
        u, v, along = uniform(seed, key, Stream.TRAINING, 0, TRIES * count, 3).unbind(-1)
        x0 = torch.stack([u * width0, v * height0], -1) + BORDER
        start, end, hits = segment_in_image(lines_through(F, x0), size1.to(torch.float64), BORDER)
        x1 = start + along[..., None] * (end - start)
        order = torch.argsort((~hits).to(torch.uint8), dim=1, stable=True)[:, :count]
        mask = hits.gather(1, order)
        x0, x1 = (torch.where(mask[..., None], x.gather(1, order[..., None].expand(-1, -1, 2)), 0.0) for x in (x0, x1))
    return VirtualPoints(x0, x1, mask)
