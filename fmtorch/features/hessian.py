"""Blobs: maxima of the determinant of the Hessian over position and scale (Lindeberg, IJCV 1998)."""

import dataclasses
import math
from typing import Annotated

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fmtorch.core.options import Within
from fmtorch.features.patches import FRAME_SIGMAS, Image
from fmtorch.features.sift import as_grey

# Maxima of a scale space: 3 x 3 x 3 neighbourhoods and the quadratic through them (Brown and Lowe, BMVC 2002)

MOVES = 4  # how often a maximum may move to the neighbour that the quadratic points to
CONVERGED = 0.6  # largest offset from the last sample, in samples; 0.5 and some slack between two samples
CHUNK = 1 << 16  # maxima refined together, which bounds memory

# (level, row, column) of the 27 samples, in the order of the volume's memory; the centre is number 13.
NEIGHBOURS = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
CENTRE = 13


def refined_maxima(
    volume: Float[Tensor, "s h w"], seeds: Int[Tensor, "m 3"], threshold: float
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
    """The maxima among `seeds`, samples (level, y, x), refined to sub-sample positions, float64, and responses.
    A seed is a maximum where it exceeds the neighbours before it in memory and no neighbour after it exceeds it, so
    that of equal neighbours one remains. A maximum moves to the sample nearest to the quadratic's; it is dropped where
    it leaves the volume, does not settle, has no maximum, or one of at most `threshold`. One remains at a sample."""
    chunks = [_refine(volume, part) for part in torch.split(seeds, CHUNK)] or [_refine(volume, seeds)]
    at, offset, value = (torch.cat(parts) for parts in zip(*chunks, strict=True))
    kept = value > threshold
    at, offset, value = at[kept], offset[kept], value[kept]
    first = np.sort(np.unique(_linear(volume, at).numpy(), return_index=True)[1])
    return at[first].double() + offset[first], value[first]


def _refine(volume: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The samples (K, 3), offsets (K, 3) and values (K,) of the seeds that are maxima and settle."""
    at = at[_exceeds_levels(volume, at)]
    v = _samples(volume, at)
    at = at[(v[CENTRE] > v[:CENTRE]).all(0) & (v[CENTRE] >= v[CENTRE + 1 :]).all(0)]
    last = torch.tensor(volume.shape) - 2
    offset, value, peaked = _quadratic(_samples(volume, at))
    for _ in range(MOVES):
        moving = torch.nonzero(peaked & (offset.abs() > CONVERGED).any(1))[:, 0]
        moved = at[moving] + offset[moving].round().clamp(-1, 1).long()
        inside = ((moved >= 1) & (moved <= last)).all(1)
        moving, moved = moving[inside], moved[inside]
        if len(moving) == 0:
            break
        at[moving] = moved
        offset[moving], value[moving], peaked[moving] = _quadratic(_samples(volume, at[moving]))
    settled = peaked & (offset.abs() <= CONVERGED).all(1)
    return at[settled], offset[settled], value[settled]


def _linear(volume: Tensor, at: Tensor) -> Tensor:
    _, h, w = volume.shape
    return (at[:, 0] * h + at[:, 1]) * w + at[:, 2]


def _samples(volume: Tensor, at: Tensor) -> Float[Tensor, "27 m"]:
    _, h, w = volume.shape
    steps = NEIGHBOURS @ torch.tensor([h * w, w, 1])
    return volume.reshape(-1)[_linear(volume, at) + steps[:, None]]


def _exceeds_levels(volume: Tensor, at: Tensor) -> Tensor:
    """Whether inner samples (M, 3) can be maxima by the samples before and after them: most seeds are not."""
    _, h, w = volume.shape
    values, place = volume.reshape(-1), _linear(volume, at)
    centre = values[place]
    return (centre > values[place - h * w]) & (centre >= values[place + h * w])


def _quadratic(v: Float[Tensor, "27 m"]) -> tuple[Tensor, Tensor, Tensor]:
    """Of the quadratic with the central differences of 27 samples: the maximum (M, 3), its value, whether there is one.
    Cramer's rule on the negative Hessian, which is positive definite at a maximum."""
    cube = v.double().reshape(3, 3, 3, -1)
    c = cube[1, 1, 1]
    sides = [cube[::2, 1, 1], cube[1, ::2, 1], cube[1, 1, ::2]]  # before and after the centre along each axis
    gs, gy, gx = (0.5 * (high - low) for low, high in sides)
    ss, yy, xx = (2 * c - low - high for low, high in sides)
    sy = -0.25 * (cube[2, 2, 1] - cube[2, 0, 1] - cube[0, 2, 1] + cube[0, 0, 1])
    sx = -0.25 * (cube[2, 1, 2] - cube[2, 1, 0] - cube[0, 1, 2] + cube[0, 1, 0])
    yx = -0.25 * (cube[1, 2, 2] - cube[1, 2, 0] - cube[1, 0, 2] + cube[1, 0, 0])
    minor = ss * yy - sy * sy
    cofactors = (yy * xx - yx * yx, sx * yx - sy * xx, sy * yx - sx * yy)
    determinant = ss * cofactors[0] + sy * cofactors[1] + sx * cofactors[2]
    peaked = (ss > 0) & (minor > 0) & (determinant > 0)
    safe = torch.where(peaked, determinant, 1.0)
    ds = (cofactors[0] * gs + cofactors[1] * gy + cofactors[2] * gx) / safe
    dy = (cofactors[1] * gs + (ss * xx - sx * sx) * gy + (sy * sx - ss * yx) * gx) / safe
    dx = (cofactors[2] * gs + (sy * sx - ss * yx) * gy + minor * gx) / safe
    return torch.stack([ds, dy, dx], 1), (c + 0.5 * (gs * ds + gy * dy + gx * dx)).to(v.dtype), peaked


KERNEL_SIGMAS = 3.0  # half the length of a sampled Gaussian
STRIP = 128  # rows worked on together: the few strips of a 1536 px image then fit a core's cache


def blur(image: Float[Tensor, "h w"], sigma: float) -> Float[Tensor, "h w"]:
    """The image convolved with a Gaussian, sampled, of sum 1, cut at `KERNEL_SIGMAS` sigma."""
    radius = math.ceil(KERNEL_SIGMAS * sigma)
    weights = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=torch.float64) / sigma) ** 2)
    kernel = (weights / weights.sum()).float().numpy()
    blurred = cv2.sepFilter2D(image.numpy(), cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    return torch.from_numpy(np.asarray(blurred))


def hessian_determinant(image: Float[Tensor, "h w"], scale: float, out: Float[Tensor, "h w"]) -> None:
    """Writes scale (Ixx Iyy - Ixy^2) by central differences; 0 on the outermost pixels."""
    pixels, result = image.numpy(), out.numpy()
    identity, first, second = (np.array(k, np.float32) for k in ([1], [-0.5, 0, 0.5], [1, -2, 1]))
    for y in range(0, len(pixels), STRIP):
        top = max(y - 1, 0)
        strip = pixels[top : y + STRIP + 1]
        kernels = ((second, identity), (identity, second), (first, first))
        xx, yy, xy = (cv2.sepFilter2D(strip, cv2.CV_32F, kx, ky) for kx, ky in kernels)
        determinant = cv2.subtract(cv2.multiply(xx, yy, dst=xx), cv2.multiply(xy, xy, dst=xy), dst=xx)
        np.multiply(determinant[y - top : y - top + STRIP], np.float32(scale), out=result[y : y + STRIP])
    result[[0, -1]] = 0
    result[:, [0, -1]] = 0


def maxima(response: Float[Tensor, "h w"], threshold: float) -> Int[Tensor, "m 2"]:
    """(y, x) of the pixels that no neighbour exceeds and that are above `threshold`, in this order."""
    values, square = response.numpy(), np.ones((3, 3), np.uint8)
    height, width = values.shape
    by_strip = []
    for y in range(0, height, STRIP):
        top = max(y - 1, 0)
        largest = cv2.dilate(values[top : y + STRIP + 1], square)[y - top : y - top + STRIP]
        strip = values[y : y + STRIP]
        maximal = strip >= largest
        maximal &= strip > threshold
        by_strip.append(np.flatnonzero(maximal) + y * width)
    place = torch.from_numpy(np.concatenate(by_strip))
    return torch.stack([place // width, place % width], 1)


IMAGE_BLUR = 0.5  # pixels: what a camera leaves; Lowe, IJCV 2004, section 3.3
SMALLEST_OCTAVE = 16  # pixels, the shorter side


def upright_frames(xy: Float[Tensor, "*n 2"], sigma: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2 3"]:
    """Square frames along the image's axes, of half side `FRAME_SIGMAS` sigma."""
    half_side = FRAME_SIGMAS * sigma
    zero = torch.zeros_like(half_side)
    return torch.stack([torch.stack([half_side, zero], -1), torch.stack([zero, half_side], -1), xy], -1)


@dataclasses.dataclass(frozen=True)
class HessianDetector:
    """Detects bright and dark blobs; an instance may be used by several threads.

    The response is ``sigma^4 (Ixx Iyy - Ixy^2)`` of intensities in [0, 1] in the Gaussian scale space. Octaves are
    halved without interpolation. A keypoint is a maximum of 26 neighbours, refined by the quadratic through them.

    max_features: the strongest that are kept, over the whole image and all scales. threshold: least response.
    levels: scales per octave. sigma: blur of the first level of an octave, in its pixels; the smallest keypoint has
    ``sigma 2^(1 / (2 levels))``. border: a keypoint closer to the image's border than `border` sigma is dropped."""

    max_features: Annotated[int, Within(1)] = 2048
    threshold: float = 1e-4
    levels: int = 3
    sigma: float = 1.6
    border: float = 3.0

    def detect(self, image: Image) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        """Upright frames of half side `FRAME_SIGMAS` sigma and responses, strongest first.
        image: grey (H, W) or RGB (H, W, 3) uint8, not empty, else ValueError. Memory: about 32 bytes a pixel."""
        grey = torch.from_numpy(as_grey(image))
        height, width = grey.shape
        by_octave = [(torch.zeros(0, 3).double(), torch.zeros(0))]
        spacing = 1.0  # of the octave's pixels in the image
        level = blur(grey.float() / 255, math.sqrt(self.sigma**2 - IMAGE_BLUR**2))
        while min(level.shape) >= SMALLEST_OCTAVE:
            responses, level = self._octave(level)
            by_level = [maxima(responses[s], self.threshold) for s in range(1, self.levels + 1)]
            seeds = [torch.cat([torch.full_like(p[:, :1], s), p], 1) for s, p in enumerate(by_level, start=1)]
            position, value = refined_maxima(responses, torch.cat(seeds), self.threshold)
            sigma = self.sigma * 2 ** (position[:, :1] / self.levels)
            by_octave.append((spacing * torch.cat([sigma, position[:, 1:]], 1), value))
            del responses
            spacing *= 2
        position, scores = (torch.cat(parts) for parts in zip(*by_octave, strict=True))
        sigma, y, x = position.unbind(1)
        inside = torch.stack([x, y, width - 1 - x, height - 1 - y]).amin(0) >= self.border * sigma
        lafs, scores = upright_frames(torch.stack([x, y], 1), sigma).float()[inside], scores[inside]
        order = torch.argsort(scores, descending=True, stable=True)[: self.max_features]
        return lafs[order], scores[order]

    def _octave(self, level: Tensor) -> tuple[Tensor, Tensor]:
        """The responses (levels + 2, h, w) of an octave from its first level, and the first level of the next."""
        volume = level.new_empty(self.levels + 2, *level.shape)
        following = level
        for s in range(self.levels + 2):
            sigma = self.sigma * 2 ** (s / self.levels)
            if s > 0:
                before = self.sigma * 2 ** ((s - 1) / self.levels)
                level = blur(level, math.sqrt(sigma**2 - before**2))
            if s == self.levels:
                following = level[::2, ::2].contiguous()
            hessian_determinant(level, sigma**4, out=volume[s])
        return volume, following
