"""The detector's and the orientation's arithmetic, written for speed: bit for bit that of the plain formulas."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from fmtorch.features import frames, hessian
from tests.features.scenes import texture

THRESHOLD = 1e-3


def response() -> Tensor:
    """(h, w) determinants of a texture, rounded so that neighbours are often equal; more rows than a strip."""
    image = torch.from_numpy(texture(0, 2 * hessian.STRIP + 11, 170)).float() / 255
    out = torch.empty_like(image)
    hessian.hessian_determinant(image, 2.0, out=out)
    return (out * 1024).round() / 1024


def test_maxima_are_those_of_the_plain_comparison() -> None:
    values = response()
    largest = F.max_pool2d(values[None], 3, stride=1, padding=1)[0]
    expected = torch.nonzero((values >= largest) & (values > THRESHOLD))
    assert len(expected) > 100
    assert torch.equal(hessian.maxima(values, THRESHOLD), expected)


def test_the_scale_of_a_determinant_is_a_product_afterwards() -> None:
    image, scale = torch.from_numpy(texture(1, hessian.STRIP + 30, 90)).float() / 255, 1.25 * 2 ** (1 / 3)
    plain, scaled = (torch.empty_like(image) for _ in range(2))
    hessian.hessian_determinant(image, 1.0, out=plain)
    hessian.hessian_determinant(image, scale, out=scaled)
    assert torch.equal(scaled, plain * scale)


def plain_histogram(patches: Tensor) -> Tensor:
    n, size = patches.shape[0], patches.shape[-1]
    padded = F.pad(patches, (1, 1, 1, 1), mode="replicate")[:, 0]
    rows = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    columns = padded[:, :, :-2] + 2 * padded[:, :, 1:-1] + padded[:, :, 2:]
    gy, gx = (columns[:, 2:] - columns[:, :-2]) / 8, (rows[:, :, 2:] - rows[:, :, :-2]) / 8
    magnitude = (gx * gx + gy * gy).sqrt() * frames._window(size, patches.device)
    position = (torch.atan2(gy, gx) + math.pi) * (frames.BINS / (2 * math.pi))
    lower = position.floor()
    upper_weight = (position - lower) * magnitude
    place = lower.long() + (frames.BINS + 2) * torch.arange(n)[:, None, None]
    votes = patches.new_zeros(n * (frames.BINS + 2))
    votes.scatter_add_(0, place.flatten(), (magnitude - upper_weight).flatten())
    votes.scatter_add_(0, place.flatten() + 1, upper_weight.flatten())
    histogram = votes.reshape(n, frames.BINS + 2)
    histogram[:, :2] += histogram[:, frames.BINS :]
    return histogram[:, : frames.BINS]


def test_histograms_of_directions_are_those_of_the_plain_formulas() -> None:
    image = texture(2, 200, 200)
    starts = np.random.default_rng(0).integers(0, 168, (90, 2))
    patches = torch.from_numpy(np.stack([image[y : y + 32, x : x + 32] for y, x in starts]))[:, None].float() / 255
    patches = torch.cat([patches, torch.full((1, 1, 32, 32), 0.5), torch.rand(20, 1, 32, 32)])
    assert torch.equal(frames._histogram(patches), plain_histogram(patches))
