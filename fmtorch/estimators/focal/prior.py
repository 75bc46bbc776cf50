"""How likely two focal lengths are: what they cost, and draws of them. All are logarithms, in units of the longer side.

Their mean is normal, and so is their difference, with a well at zero for images of one size: these mostly come from one
camera.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core import random
from fmtorch.core.random import Stream
from fmtorch.estimators.pairs import NormalizedPairs

USUAL_FOCAL = 1.2  # median focal length in units of the longer image side
FOCAL_DEVIATION = 0.4  # of its logarithm, averaged over the two images
RATIO_DEVIATION = 0.5  # of the logarithm of the two focal lengths' ratio, for images of different sizes
SAME_CAMERA_DEVIATION = 0.01  # width of the well for images of equal size
SAME_CAMERA_GAIN = 5.0  # its depth, in logarithms of the likelihood
SAME_CAMERA_SHARE = 0.7  # of the draws for images of equal size that have one focal length for both
_BITS = 10
NORMAL = torch.special.ndtri((torch.arange(1 << _BITS, dtype=torch.float64) + 0.5) / (1 << _BITS))


def focal_cost(focal: Float[Tensor, "2 p k"], same_size: Bool[Tensor, " p"]) -> tuple[Tensor, Tensor, Tensor]:
    """The cost of two log focal lengths, its gradient (2, p, k) and a Gauss-Newton matrix (2, 2, p, k)."""
    difference = focal[0] - focal[1]
    squared = difference * difference
    mean = (focal[0] + focal[1]) * (0.5 / FOCAL_DEVIATION) - math.log(USUAL_FOCAL) / FOCAL_DEVIATION
    width2 = SAME_CAMERA_DEVIATION**2
    well = torch.where(same_size, width2, 0.0)[:, None] / (squared + width2)
    precision = 1 / RATIO_DEVIATION**2 + 2 * SAME_CAMERA_GAIN / width2 * well * well
    cost = mean * mean / 2 + squared / (2 * RATIO_DEVIATION**2) - SAME_CAMERA_GAIN * well
    b = 0.5 / FOCAL_DEVIATION
    pull = precision * difference
    gradient = torch.stack([b * mean + pull, b * mean - pull])
    own, other = b * b + precision, b * b - precision
    return cost, gradient, torch.stack([torch.stack([own, other]), torch.stack([other, own])])


def draw_focal_lengths(
    pairs: NormalizedPairs, same_size: Bool[Tensor, " p"], start: int, count: int
) -> Float[Tensor, "2 p s"]:
    """Log focal lengths of both images for the draws start .. start + count - 1."""
    bits = random.bits(pairs.seed, pairs.key, Stream.FOCAL, start, count, 3) & ((1 << _BITS) - 1)
    normal = NORMAL.to(bits.device)
    mean = math.log(USUAL_FOCAL) + FOCAL_DEVIATION * normal[bits[..., 0]]
    half = RATIO_DEVIATION / 2 * normal[bits[..., 1]]
    equal = same_size[:, None] & (bits[..., 2] < SAME_CAMERA_SHARE * (1 << _BITS))
    half = torch.where(equal, 0.0, half)
    return torch.stack([mean + half, mean - half])
