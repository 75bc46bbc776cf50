"""`focal.cameras` on the arrays of one pair: two cameras for each candidate, and matches from the principal points."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fmtorch.estimators.focal.cameras import MIN_IMAGE_SIDE_PX
from fmtorch.estimators.focal.cameras_kernels import centre
from fmtorch.estimators.one_pair.pair import Array, OnePair


class TwoCameras(NamedTuple):
    """As `cameras.TwoCameras`, of k candidates: axes (k, 2, 3, 3), U and V, rows first; focal (k, 2), logarithms.

    Of one model (2, 3, 3) and (2,), `UNKNOWN` where none are assumed.
    """

    axes: Array
    focal: Array

    @property
    def known(self) -> bool:
        """Of one model: whether cameras are assumed."""
        return math.isfinite(self.focal[0])

    def of(self, k: int) -> TwoCameras:
        """Those of one candidate."""
        return TwoCameras(self.axes[k], self.focal[k])

    def joined(self, other: TwoCameras) -> TwoCameras:
        """The candidates of both."""
        return TwoCameras(np.concatenate([self.axes, other.axes]), np.concatenate([self.focal, other.focal]))


UNKNOWN = TwoCameras(np.full((2, 3, 3), np.nan), np.full(2, np.nan))
"""No assumption about the cameras of one model."""


class CentredPair(NamedTuple):
    """As `cameras.CentredPairs`: points (4, n) from the principal points; offset (4,); longest (2,); same_size.

    s2: (n,), the squared scales of a loss, in the unit of the points; precision: (n,), one over these.
    """

    points: Array
    s2: Array
    precision: Array
    offset: Array
    longest: Array
    same_size: bool

    @staticmethod
    def of(pair: OnePair, scale_px: float = 1.0) -> CentredPair:
        """The matches of a pair whose image sizes are known, made once. scale_px: of the loss."""
        made: CentredPair = pair.once(("centred", scale_px), lambda pair: _centred(pair, scale_px))
        return made


def images_of(pair: OnePair) -> tuple[Array, Array, bool]:
    """Offset, longest and same_size of `CentredPair`, made once."""
    images: tuple[Array, Array, bool] | None = pair.shared.get("images")
    if images is None:
        images = pair.shared["images"] = _images(pair)
    return images


def _centred(pair: OnePair, scale_px: float) -> CentredPair:
    images, out = images_of(pair), np.empty((6, pair.count))
    centre(pair.table, images[0], scale_px, out)
    return CentredPair(out[:4], out[4], out[5], *images)


def _images(pair: OnePair) -> tuple[Array, Array, bool]:
    unit, (h0, w0, h1, w1) = pair.pixels_per_unit, pair.sizes.tolist()
    sides = w0, h0, w1, h1
    pixel = 0.0 if max(sides) < MIN_IMAGE_SIDE_PX else 1.0
    offset = np.array([(x - (side - pixel) / 2) / unit for x, side in zip(pair.centre.tolist(), sides, strict=True)])
    longest = np.array([max(h0, w0) / unit, max(h1, w1) / unit])
    return offset, longest, pair.same_size[0]
