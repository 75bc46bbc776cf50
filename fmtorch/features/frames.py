"""Orientation and affine shape of local affine frames, by what their patches show."""

import dataclasses
import functools
import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.features.patches import PATCH, ImagePyramid, frame_scale, make_upright, rotate_frames

PatchFunction = Callable[[Tensor], Tensor]  # patches (N, 1, 32, 32) float32 in [0, 1] -> (N, D): `PatchNetwork`

BINS = 36  # of the orientation histogram, 10 degrees each; Lowe, IJCV 2004, section 5
WINDOW = PATCH / 6  # pixels, sigma of the Gaussian window: 2 keypoint sigmas
CHUNK = 128  # patches worked on together: their gradients fit a core's cache
SMOOTHING = 1.6  # bins, sigma of the histogram's blur; kornia's


@dataclasses.dataclass(frozen=True)
class DominantGradient:
    """Turns the first axis to the highest peak of gradient directions (Lowe, IJCV 2004, section 5), one a frame."""

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 3"]:
        return rotate_frames(lafs, dominant_gradient(pyramid.extract(lafs)))


@dataclasses.dataclass(frozen=True)
class NetworkOrientation:
    """Turns the first axis as OriNet says (Mishkin et al., ECCV 2018): patches (N, 1, 32, 32) -> (y, x), (N, 2)."""

    network: PatchFunction

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 3"]:
        if len(lafs) == 0:
            return lafs
        y, x = self.network(pyramid.extract(lafs)).to(lafs).unbind(1)
        return rotate_frames(lafs, torch.atan2(y, x))


def dominant_gradient(patches: Float[Tensor, "n 1 p p"]) -> Float[Tensor, " n"]:
    """The direction of the dominant gradient, towards bright, in radians counter-clockwise on the screen.
    Sobel gradients, weighted by a Gaussian window, vote for the two nearest of `BINS` directions; the smoothed
    histogram's highest peak is refined by a parabola. A patch without gradient gives pi."""
    parts = [_histogram(part) for part in torch.split(patches, CHUNK)]
    histogram = torch.cat(parts) if parts else patches.new_zeros(0, BINS)
    taps = [math.exp(-0.5 * (step / SMOOTHING) ** 2) for step in range(-2, 3)]
    shifted = (weight / sum(taps) * histogram.roll(step, 1) for step, weight in zip(range(-2, 3), taps, strict=True))
    smooth = functools.reduce(torch.add, shifted)
    value, peak = smooth.max(1)
    left, right = (smooth.gather(1, ((peak + step) % BINS)[:, None])[:, 0] for step in (-1, 1))
    curvature = left + right - 2 * value
    offset = torch.where(curvature < 0, 0.5 * (left - right) / torch.where(curvature < 0, curvature, -1.0), 0.0)
    return math.pi - (peak + offset) * (2 * math.pi / BINS)


def _histogram(patches: Float[Tensor, "n 1 p p"]) -> Float[Tensor, "n k"]:
    """Votes for the directions -pi, -pi + 2 pi / BINS, ..., clockwise on the screen."""
    n, size = patches.shape[0], patches.shape[-1]
    gy, gx = _sobel(patches)
    position = torch.atan2(gy, gx).add_(math.pi).mul_(BINS / (2 * math.pi))
    magnitude = gx.square_().add_(gy.square_()).sqrt_().mul_(_window(size, patches.device))
    lower = position.floor()
    upper_weight = position.sub_(lower).mul_(magnitude)
    # BINS + 2 places: pi, where a direction ends up that is -pi, and the place above it.
    start = (BINS + 2) * torch.arange(n, device=patches.device)
    place = lower.long().add_(start[:, None, None]).flatten()
    votes = patches.new_zeros(n * (BINS + 2))
    votes.scatter_add_(0, place, magnitude.sub_(upper_weight).flatten())
    votes[1:].scatter_add_(0, place, upper_weight.flatten())
    histogram = votes.reshape(n, BINS + 2)
    histogram[:, :2] += histogram[:, BINS:]
    return histogram[:, :BINS]


def _sobel(patches: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives along y and x (N, P, P); the border is continued."""
    padded = torch.nn.functional.pad(patches, (1, 1, 1, 1), mode="replicate")[:, 0]
    rows = torch.add(padded[:, :-2], padded[:, 1:-1], alpha=2).add_(padded[:, 2:])
    columns = torch.add(padded[:, :, :-2], padded[:, :, 1:-1], alpha=2).add_(padded[:, :, 2:])
    return (columns[:, 2:] - columns[:, :-2]).div_(8), (rows[:, :, 2:] - rows[:, :, :-2]).div_(8)


@functools.cache
def _window(size: int, device: torch.device) -> Float[Tensor, "p p"]:
    x = torch.arange(size, device=device) - (size - 1) / 2
    weight = torch.exp(-0.5 * (x / (WINDOW * size / PATCH)) ** 2)
    return weight[:, None] * weight


# Affine shape of local frames by AffNet (Mishkin, Radenovic, Matas, ECCV 2018)

LONGEST = 6.0  # largest ratio of a region's axes; Perdoch et al., CVPR 2009, give up on longer ones


@dataclasses.dataclass(frozen=True)
class NetworkShape:
    """Gives frames the affine shape that a network sees in their upright patches.
    network: patches (N, 1, 32, 32) -> (N, 3), the shape [[1 + x0, 0], [x1, 1 + x2]] in the patch's coordinates."""

    network: PatchFunction

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 3"]:
        """Upright frames of the same centres and areas with the new shape.
        A frame keeps its shape where the new one is singular, not finite, or longer than `LONGEST`."""
        upright = make_upright(lafs)
        if len(lafs) == 0:
            return upright
        x0, x1, x2 = self.network(pyramid.extract(upright)).to(lafs).unbind(1)
        zero = torch.zeros_like(x0)
        shape = torch.stack([torch.stack([1 + x0, zero], 1), torch.stack([x1, 1 + x2], 1)], 1)
        first, second, centre = upright.unbind(-1)
        columns = [first * shape[:, :1, k] + second * shape[:, 1:, k] for k in (0, 1)]
        shaped = make_upright(torch.stack([*columns, centre], -1))
        factor = frame_scale(upright) / frame_scale(shaped)
        shaped = torch.cat([shaped[..., :2] * factor[:, None, None], shaped[..., 2:]], -1)
        scale = frame_scale(shaped)
        # Half the sum a^2 + 1 / a^2 of the squared axes of the ellipse that a frame makes of the unit circle.
        half_sum = 0.5 * shaped[..., :2].square().sum((1, 2)) / (scale * scale)
        elongation = half_sum + (half_sum * half_sum - 1).clamp(min=0).sqrt()
        valid = torch.isfinite(shaped).all(2).all(1) & (elongation <= LONGEST)
        return torch.where(valid[:, None, None], shaped, upright)
