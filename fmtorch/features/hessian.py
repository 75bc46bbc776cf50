"""Blobs: maxima of the determinant of the Hessian over position and scale (Lindeberg, IJCV 1998)."""

import dataclasses
import math
from typing import Annotated, NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.options import Within
from fmtorch.features.frames import upright_frames
from fmtorch.features.sift import as_grey

# Maxima of a scale space: 3 x 3 x 3 neighbourhoods and the quadratic through them (Brown and Lowe, BMVC 2002)


MOVES = 4  # how often a maximum may move to the neighbour that the quadratic points to
CONVERGED = 0.6  # largest offset from the last sample, in samples; 0.5 and some slack between two samples
CHUNK = 1 << 16  # maxima refined together, which bounds memory

# (level, row, column) of the 27 samples, in the order of the volume's memory; the centre is number 13.
NEIGHBOURS = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
CENTRE = 13


class Peaks(NamedTuple):
    """Refined maxima. image: index (M,). position: (level, y, x) in samples (M, 3) float64. value: response (M,)."""

    image: Int[Tensor, " m"]
    position: Float[Tensor, "m 3"]
    value: Float[Tensor, " m"]


def refined_maxima(volume: Float[Tensor, "b s h w"], seeds: Int[Tensor, "m 4"], threshold: float) -> Peaks:
    """The maxima among `seeds`, samples (b, level, y, x), refined to sub-sample positions and values.

    A seed is a maximum where it exceeds the neighbours before it in memory and no neighbour after it exceeds it, so
    that of equal neighbours one remains. A maximum moves to the sample nearest to the quadratic's; it is dropped where
    it leaves the volume, does not settle, the quadratic has no maximum, or its value is at most `threshold`. Of those
    that end at one sample one remains.
    """
    chunks = [_refine(volume, part) for part in torch.split(seeds, CHUNK)] or [_refine(volume, seeds)]
    at, offset, value = (torch.cat(parts) for parts in zip(*chunks, strict=True))
    kept = value > threshold
    at, offset, value = at[kept], offset[kept], value[kept]
    first = _first_of_each(_linear(volume, at))
    return Peaks(at[first, 0], at[first, 1:].double() + offset[first], value[first])


def _refine(volume: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The samples (K, 4), offsets (K, 3) and values (K,) of the seeds that are maxima and settle."""
    at = at[_exceeds_levels(volume, at)]
    at = at[_is_maximum(_samples(volume, at))]
    last = torch.tensor(volume.shape[1:], device=volume.device) - 2
    offset, value, peaked = _quadratic(_samples(volume, at))
    for _ in range(MOVES):
        moving = torch.nonzero(peaked & (offset.abs() > CONVERGED).any(1))[:, 0]
        moved = at[moving, 1:] + offset[moving].round().clamp(-1, 1).long()
        inside = ((moved >= 1) & (moved <= last)).all(1)
        moving, moved = moving[inside], moved[inside]
        if len(moving) == 0:
            break
        at[moving, 1:] = moved
        offset[moving], value[moving], peaked[moving] = _quadratic(_samples(volume, at[moving]))
    settled = peaked & (offset.abs() <= CONVERGED).all(1)
    return at[settled], offset[settled], value[settled]


def _linear(volume: Tensor, at: Tensor) -> Tensor:
    """Position in memory of the samples (M, 4)."""
    _, s, h, w = volume.shape
    return ((at[:, 0] * s + at[:, 1]) * h + at[:, 2]) * w + at[:, 3]


def _samples(volume: Tensor, at: Tensor) -> Float[Tensor, "27 m"]:
    """The neighbourhoods of inner samples (M, 4)."""
    _, _, h, w = volume.shape
    steps = NEIGHBOURS.to(volume.device) @ torch.tensor([h * w, w, 1], device=volume.device)
    return volume.reshape(-1)[_linear(volume, at) + steps[:, None]]


def _exceeds_levels(volume: Tensor, at: Tensor) -> Tensor:
    """Whether inner samples (M, 4) can be maxima by the samples before and after them: most seeds are not."""
    _, _, h, w = volume.shape
    values, place = volume.reshape(-1), _linear(volume, at)
    centre = values[place]
    return (centre > values[place - h * w]) & (centre >= values[place + h * w])


def _is_maximum(v: Float[Tensor, "27 m"]) -> Tensor:
    return (v[CENTRE] > v[:CENTRE]).all(0) & (v[CENTRE] >= v[CENTRE + 1 :]).all(0)


def _quadratic(v: Float[Tensor, "27 m"]) -> tuple[Tensor, Tensor, Tensor]:
    """Of the quadratic with the central differences of 27 samples: the maximum (M, 3), its value, whether there is one.

    Cramer's rule on the negative Hessian, which is positive definite at a maximum.
    """
    cube = v.double().reshape(3, 3, 3, -1)
    c = cube[1, 1, 1]
    gs, gy, gx = (
        0.5 * (high - low)
        for low, high in (
            (cube[0, 1, 1], cube[2, 1, 1]),
            (cube[1, 0, 1], cube[1, 2, 1]),
            (cube[1, 1, 0], cube[1, 1, 2]),
        )
    )
    ss, yy, xx = (
        2 * c - low - high
        for low, high in (
            (cube[0, 1, 1], cube[2, 1, 1]),
            (cube[1, 0, 1], cube[1, 2, 1]),
            (cube[1, 1, 0], cube[1, 1, 2]),
        )
    )
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
    value = c + 0.5 * (gs * ds + gy * dy + gx * dx)
    return torch.stack([ds, dy, dx], 1), value.to(v.dtype), peaked


def _first_of_each(key: Tensor) -> Tensor:
    """Indices, in order, of the first occurrence of each key."""
    order = torch.argsort(key, stable=True)
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = key[order[1:]] != key[order[:-1]]
    return order[first].sort().values


# The image filters of the detectors twice: by OpenCV for one image on a CPU, by torch for a batch on any device

KERNEL_SIGMAS = 3.0  # half the length of a sampled Gaussian
STRIP = 128  # rows worked on together: the few strips of a 1536 px image then fit a core's cache


@runtime_checkable
class Filters(Protocol):
    """What a detector needs of an image (B, h, w)."""

    def blur(self, image: Float[Tensor, "b h w"], sigma: float) -> Float[Tensor, "b h w"]:
        """The image convolved with a Gaussian."""

    def hessian_determinant(self, image: Float[Tensor, "b h w"], scale: float, out: Float[Tensor, "b h w"]) -> None:
        """Writes scale (Ixx Iyy - Ixy^2) by central differences; 0 on the outermost pixels."""

    def maxima(self, response: Float[Tensor, "b h w"], threshold: float) -> Int[Tensor, "m 3"]:
        """(b, y, x) of the pixels that no neighbour exceeds and that are above `threshold`, in this order."""


def gaussian_kernel(sigma: float) -> Float[Tensor, " k"]:
    """A sampled Gaussian of sum 1, cut at `KERNEL_SIGMAS` sigma."""
    radius = math.ceil(KERNEL_SIGMAS * sigma)
    x = torch.arange(-radius, radius + 1, dtype=torch.float64)
    kernel = torch.exp(-0.5 * (x / sigma) ** 2)
    return (kernel / kernel.sum()).float()


class OpenCVFilters:
    """`Filters` for one image on the CPU."""

    def blur(self, image: Float[Tensor, "1 h w"], sigma: float) -> Float[Tensor, "1 h w"]:
        kernel = gaussian_kernel(sigma).numpy()
        blurred = cv2.sepFilter2D(image[0].numpy(), cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
        return torch.from_numpy(np.asarray(blurred))[None]

    def hessian_determinant(self, image: Float[Tensor, "1 h w"], scale: float, out: Float[Tensor, "1 h w"]) -> None:
        pixels, result = image[0].numpy(), out[0].numpy()
        identity, first, second = (np.array(k, np.float32) for k in ([1], [-0.5, 0, 0.5], [1, -2, 1]))
        h = len(pixels)
        for y in range(0, h, STRIP):
            top, bottom = max(y - 1, 0), min(y + STRIP + 1, h)
            strip = pixels[top:bottom]
            xx, yy, xy = (
                cv2.sepFilter2D(strip, cv2.CV_32F, kx, ky)
                for kx, ky in ((second, identity), (identity, second), (first, first))
            )
            determinant = cv2.subtract(cv2.multiply(xx, yy, dst=xx), cv2.multiply(xy, xy, dst=xy), dst=xx)
            np.multiply(determinant[y - top : y - top + STRIP], np.float32(scale), out=result[y : y + STRIP])
        result[[0, -1]] = 0
        result[:, [0, -1]] = 0

    def maxima(self, response: Float[Tensor, "1 h w"], threshold: float) -> Int[Tensor, "m 3"]:
        values = response[0].numpy()
        h, width = values.shape
        square = np.ones((3, 3), np.uint8)
        by_strip = []
        for y in range(0, h, STRIP):
            top, bottom = max(y - 1, 0), min(y + STRIP + 1, h)
            largest = cv2.dilate(values[top:bottom], square)[y - top : y - top + STRIP]
            strip = values[y : y + STRIP]
            maximal = strip >= largest
            maximal &= strip > threshold
            by_strip.append(np.flatnonzero(maximal) + y * width)
        place = torch.from_numpy(np.concatenate(by_strip))
        return torch.stack([torch.zeros_like(place), place // width, place % width], 1)


class TorchFilters:
    """`Filters` for a batch on its device."""

    def blur(self, image: Float[Tensor, "b h w"], sigma: float) -> Float[Tensor, "b h w"]:
        # Tap by tap: a convolution's rounding depends on the batch.
        kernel = gaussian_kernel(sigma).tolist()
        radius, (_, h, w) = len(kernel) // 2, image.shape
        padded = F.pad(image[:, None], (radius, radius, 0, 0), mode="replicate")[:, 0]
        rows = sum((k * padded[:, :, i : i + w] for i, k in enumerate(kernel)), torch.zeros_like(image))
        padded = F.pad(rows[:, None], (0, 0, radius, radius), mode="replicate")[:, 0]
        return sum((k * padded[:, i : i + h] for i, k in enumerate(kernel)), torch.zeros_like(image))

    def hessian_determinant(self, image: Float[Tensor, "b h w"], scale: float, out: Float[Tensor, "b h w"]) -> None:
        middle = image[:, 1:-1, 1:-1]
        xx = image[:, 1:-1, 2:] - 2 * middle + image[:, 1:-1, :-2]
        yy = image[:, 2:, 1:-1] - 2 * middle + image[:, :-2, 1:-1]
        xy = 0.25 * (image[:, 2:, 2:] - image[:, 2:, :-2] - image[:, :-2, 2:] + image[:, :-2, :-2])
        out.zero_()
        out[:, 1:-1, 1:-1] = scale * (xx * yy - xy * xy)

    def maxima(self, response: Float[Tensor, "b h w"], threshold: float) -> Int[Tensor, "m 3"]:
        largest = F.max_pool2d(response, 3, stride=1, padding=1)
        return torch.nonzero((response >= largest) & (response > threshold))


IMAGE_BLUR = 0.5  # pixels: what a camera leaves; Lowe, IJCV 2004, section 3.3
SMALLEST_OCTAVE = 16  # pixels, the shorter side


@dataclasses.dataclass(frozen=True)
class HessianDetector:
    """Detects bright and dark blobs; an instance may be used by several threads.

    The response is ``sigma^4 (Ixx Iyy - Ixy^2)`` of intensities in [0, 1] in the Gaussian scale space. Octaves are
    halved without interpolation: pixel x of an octave is pixel 2x of the one before. A keypoint is a maximum among its
    26 neighbours, refined by the quadratic through them.

    max_features: the strongest that are kept, over the whole image and all scales. threshold: least response.
    levels: scales per octave. sigma: blur of the first level of an octave, in its pixels; the smallest keypoint has
    ``sigma 2^(1 / (2 levels))``. border: a keypoint closer to the image's border than `border` sigma is dropped.
    """

    max_features: Annotated[int, Within(1)] = 2048
    threshold: float = 1e-4
    levels: int = 3
    sigma: float = 1.6
    border: float = 3.0

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        """Upright frames of half side `FRAME_SIGMAS` sigma and responses, strongest first, through OpenCV's filters.

        image: grey (H, W) or RGB (H, W, 3) uint8. N = 0 where nothing is found. Memory: about 32 bytes a pixel.
        Raises ValueError for another type, shape or an empty image.
        """
        grey = torch.from_numpy(as_grey(image))[None]
        lafs, scores, _ = self._detect(grey.float() / 255, OpenCVFilters())
        return lafs[0], scores[0]

    def detect_batch(
        self, images: Float[Tensor, "b 1 h w"]
    ) -> tuple[Float[Tensor, "b n 2 3"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
        """`detect` for a batch of grey images in [0, 1] on their device: frames, responses, mask.

        Padded with zeros to the image with most keypoints. Equal to `detect` up to the rounding of the filters.
        """
        return self._detect(images[:, 0], TorchFilters())

    def _detect(self, images: Tensor, filters: Filters) -> tuple[Tensor, Tensor, Tensor]:
        by_octave = [
            Peaks(images.new_zeros(0, dtype=torch.int64), images.new_zeros(0, 3).double(), images.new_zeros(0))
        ]
        batch, height, width = images.shape
        spacing = 1.0  # of the octave's pixels in the image
        level = filters.blur(images, math.sqrt(self.sigma**2 - IMAGE_BLUR**2))
        while min(level.shape[1:]) >= SMALLEST_OCTAVE:
            responses, level = self._octave(level, filters)
            seeds = [filters.maxima(responses[:, s], self.threshold) for s in range(1, self.levels + 1)]
            at = [torch.cat([p[:, :1], torch.full_like(p[:, :1], s + 1), p[:, 1:]], 1) for s, p in enumerate(seeds)]
            peaks = refined_maxima(responses, torch.cat(at), self.threshold)
            sigma = self.sigma * 2 ** (peaks.position[:, :1] / self.levels)
            by_octave.append(peaks._replace(position=spacing * torch.cat([sigma, peaks.position[:, 1:]], 1)))
            del responses
            spacing *= 2
        index, position, scores = (torch.cat(parts) for parts in zip(*by_octave, strict=True))
        sigma, y, x = position.unbind(1)
        nearest = torch.stack([x, y, width - 1 - x, height - 1 - y]).amin(0)
        inside = nearest >= self.border * sigma
        lafs = upright_frames(torch.stack([x, y], 1), sigma).float()
        return _strongest(lafs[inside], scores[inside], index[inside], batch, self.max_features)

    def _octave(self, level: Tensor, filters: Filters) -> tuple[Tensor, Tensor]:
        """The responses (B, levels + 2, h, w) of an octave from its first level, and the first level of the next."""
        volume = level.new_empty(level.shape[0], self.levels + 2, *level.shape[1:])
        following = level
        for s in range(self.levels + 2):
            blur = self.sigma * 2 ** (s / self.levels)
            if s > 0:
                before = self.sigma * 2 ** ((s - 1) / self.levels)
                level = filters.blur(level, math.sqrt(blur**2 - before**2))
            if s == self.levels:
                following = level[:, ::2, ::2].contiguous()
            filters.hessian_determinant(level, blur**4, out=volume[:, s])
        return volume, following


def _strongest(
    lafs: Float[Tensor, "m 2 3"], scores: Float[Tensor, " m"], image: Tensor, batch: int, count: int
) -> tuple[Float[Tensor, "b n 2 3"], Float[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """The `count` highest scores of each image in falling order, ties in the order given, padded with zeros."""
    order = torch.argsort(scores, descending=True, stable=True)
    chosen = [order[image[order] == i][:count] for i in range(batch)]
    longest = max((len(i) for i in chosen), default=0)
    out_lafs, out_scores = lafs.new_zeros(batch, longest, 2, 3), scores.new_zeros(batch, longest)
    mask = torch.zeros(batch, longest, dtype=torch.bool, device=lafs.device)
    for i, kept in enumerate(chosen):
        out_lafs[i, : len(kept)], out_scores[i, : len(kept)], mask[i, : len(kept)] = lafs[kept], scores[kept], True
    return out_lafs, out_scores, mask
