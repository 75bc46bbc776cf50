"""The image filters of the detectors twice: by OpenCV for one image on a CPU, by torch for a batch on any device.

Images are (B, h, w) with B = 1 for OpenCV, float32; borders are continued. Both give the same up to rounding.
"""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

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
