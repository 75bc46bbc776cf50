"""The nearest-neighbour matcher: Features x Features -> Correspondences."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences, Features
from fmtorch.matching.nearest import nearest_neighbors


@dataclasses.dataclass(frozen=True)
class NearestNeighborMatcher:
    """Matches every feature of image 0 with the feature of image 1 whose descriptor is nearest (Euclidean).

    The slots of the result are the features of image 0, in their order; `mask` is True for those that found a
    partner. `ratio` is the ratio of the distances to the nearest and the second nearest descriptor, in [0, 1], and
    1 where it means nothing (a single candidate, two identical candidates).

    mutual: keep only matches whose partner's own nearest neighbour is the feature itself. It costs nothing, both
    directions being found in one pass; without it the result says which matches these are (`Correspondences.mutual`).
    chunk: rows of the distance matrix that exist at a time; changes speed and memory only.
    """

    mutual: bool = False
    chunk: int = 64

    def __call__(self, features0: Features, features1: Features) -> Correspondences:
        """The matches of one pair (a batch of one), or of a batch of pairs when the features have a leading dimension.

        Raises ValueError when the two batches or descriptor lengths differ.
        """
        shape0, shape1 = features0.descriptors.shape, features1.descriptors.shape
        if shape0[:-2] != shape1[:-2] or shape0[-1] != shape1[-1]:
            raise ValueError(
                f"descriptors {tuple(shape0)} and {tuple(shape1)} do not fit: batch and length must be the same"
            )
        if len(shape0) == 2:
            features0, features1 = (f.replace(**_batch_of_one(f)) for f in (features0, features1))
        neighbors = nearest_neighbors(
            features0.descriptors, features1.descriptors, features0.valid, features1.valid, chunk=self.chunk
        )
        mask = neighbors.nearest >= 0
        lafs1 = _take(features1.lafs, neighbors.nearest)
        return Correspondences(
            x0=features0.keypoints,
            x1=lafs1[..., 2],
            mask=mask & neighbors.mutual if self.mutual else mask,
            ratio=neighbors.ratio.to(features0.lafs.dtype),
            lafs0=features0.lafs,
            lafs1=lafs1,
            size0=features0.image_size,
            size1=features1.image_size,
            mutual=neighbors.mutual & mask,
        )


def _batch_of_one(features: Features) -> dict[str, Tensor]:
    return {f.name: getattr(features, f.name)[None] for f in dataclasses.fields(features)}


def _take(lafs: Tensor, index: Int[Tensor, "b n0"]) -> Tensor:
    """The frames at `index`, zero where it is -1."""
    if lafs.shape[1] == 0:
        return lafs.new_zeros(*index.shape, 2, 3)
    taken = lafs.gather(1, index.clamp(min=0)[..., None, None].expand(-1, -1, 2, 3))
    return torch.where(index[..., None, None] >= 0, taken, 0.0)


# How exact each match is, from the precision matrices that RoMa v2 gives with it

Array = NDArray[np.float64]
MAX_RATIO = 4.0  # of the noise of a match to the pair's usual one, either way: as far as frames tell (`match_noise`)


class RecordedSample:
    """The last matches that a RoMa v2 behind vismatch sampled, whose precisions vismatch does not hand on.

    ``sample`` of the released model gives matches (N, 4) in [-1, 1], overlaps (N,), and precision matrices (N, 2, 2) in
    the pixels of both images as the model saw them (Edstedt et al., 2025).
    """

    def __init__(self, model: Any) -> None:
        self._model, self._sample = model, model.sample
        self._last: Sequence[Any] | None = None
        model.sample = self

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """What the model samples, remembered."""
        self._last = self._sample(*arguments, **named)
        return self._last

    @classmethod
    def of(cls, matcher: Any) -> RecordedSample | None:
        """Of a matcher of vismatch that is a RoMa v2; None for any other."""
        model = getattr(matcher, "romav2_model", None)
        return cls(model) if hasattr(model, "sample") and hasattr(model, "to_pixel_coordinates") else None

    def take(self, sizes: Sequence[tuple[int, int]]) -> tuple[Array, Array, Array, tuple[Array, Array]]:
        """The last sample: points (N, 2) of both images, overlaps (N,), and precisions (N, 2, 2) in pixels of both.

        sizes: (h, w) of the images. Raises ValueError where nothing was sampled, or without precisions.
        """
        last, self._last = self._last, None
        if last is None or len(last) != 4 or last[2] is None or last[3] is None:
            raise ValueError("the model sampled no matches with precisions")
        (h0, w0), (h1, w1) = sizes
        x0, x1 = self._model.to_pixel_coordinates(last[0], h0, w0, h1, w1)
        seen = (self._model.H_hr or self._model.H_lr, self._model.W_hr or self._model.W_lr)
        precisions = [_scaled(_array(p), seen, size) for p, size in zip(last[2:], sizes, strict=True)]
        return _array(x0), _array(x1), _array(last[1]).reshape(-1), (precisions[0], precisions[1])


def relative_noise(precision0: Array, precision1: Array) -> Array:
    """The noise of each match, in units of the pair's median, from precision matrices (N, 2, 2), 1 / px^2.

    The engine's noise is a standard deviation across an epipolar line. Over all directions n of that line the mean of
    the variance ``n^T C n`` of a covariance C is ``tr(C) / 2``: the noise is the square root of it, averaged over both
    images. (Equal determinants would be too sure of matches along an edge.) Within `MAX_RATIO` of the median; 1 where a
    precision is no positive matrix.
    """
    variance = (_mean_variance(precision0) + _mean_variance(precision1)) / 2
    valid = np.isfinite(variance)
    if not valid.any():
        return np.ones(len(variance))
    usual = np.median(np.sqrt(variance[valid]))
    noise = np.sqrt(np.where(valid, variance, usual**2)) / usual
    bounded: Array = np.clip(noise, 1 / MAX_RATIO, MAX_RATIO)
    return bounded


def _mean_variance(precision: Array) -> Array:
    """tr(P^-1) / 2 = tr(P) / (2 det P); NaN where P is not positive definite."""
    a, b, c, d = (precision[:, i, j] for i in (0, 1) for j in (0, 1))
    determinant = a * d - b * c
    positive = np.isfinite(precision).all((1, 2)) & (a > 0) & (determinant > 0)
    variance = np.full(len(precision), np.nan)
    variance[positive] = ((a + d)[positive] / determinant[positive]) / 2
    return variance


def _scaled(precision: Array, seen: tuple[int, int], size: tuple[int, int]) -> Array:
    """Precisions in pixels of an image of `size` (h, w), of which the model saw a copy of another size."""
    ratio = np.array([seen[1] / size[1], seen[0] / size[0]])
    scaled: Array = precision * ratio[:, None] * ratio
    return scaled


def _array(value: Any) -> Array:
    return np.asarray(value.detach().to(torch.float64).cpu() if isinstance(value, Tensor) else value, np.float64)
