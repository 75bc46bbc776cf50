"""How exact each match is, from the precision matrices that RoMa v2 gives with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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
