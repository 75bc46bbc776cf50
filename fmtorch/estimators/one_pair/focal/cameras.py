"""`focal.cameras` on the arrays of one pair: two cameras for each candidate, and matches from the principal points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmtorch.estimators.focal.cameras import MIN_IMAGE_SIDE_PX
from fmtorch.estimators.one_pair.pair import Array, OnePair


class TwoCameras(NamedTuple):
    """As `cameras.TwoCameras`, of k candidates: axes (k, 2, 3, 3), U and V, rows first; focal (k, 2), logarithms.

    Of one model (2, 3, 3) and (2,), NaN where none are assumed.
    """

    axes: Array
    focal: Array

    @staticmethod
    def none() -> TwoCameras:
        """No assumption about the cameras of one model."""
        return TwoCameras(np.full((2, 3, 3), np.nan), np.full(2, np.nan))

    @property
    def known(self) -> bool:
        """Of one model: whether cameras are assumed."""
        return bool(np.isfinite(self.focal[0]))

    def of(self, k: int) -> TwoCameras:
        """Those of one candidate."""
        return TwoCameras(self.axes[k], self.focal[k])

    def joined(self, other: TwoCameras) -> TwoCameras:
        """The candidates of both."""
        return TwoCameras(np.concatenate([self.axes, other.axes]), np.concatenate([self.focal, other.focal]))


class CentredPair(NamedTuple):
    """As `cameras.CentredPairs`: points (4, n) from the principal points; offset (4,); longest (2,); same_size."""

    points: Array
    offset: Array
    longest: Array
    same_size: bool

    @staticmethod
    def of(pair: OnePair) -> CentredPair:
        """The matches of a pair whose image sizes are known, made once."""
        made: CentredPair = pair.once("from the principal points", lambda: _centred(pair))
        return made


def _centred(pair: OnePair) -> CentredPair:
    assert pair.sizes is not None
    unit, sizes = pair.pixels_per_unit, pair.sizes.ravel().tolist()
    h0, w0, h1, w1 = sizes
    sides = w0, h0, w1, h1
    pixel = 0.0 if max(sides) < MIN_IMAGE_SIDE_PX else 1.0
    offset = np.array([(x - (side - pixel) / 2) / unit for x, side in zip(pair.centre.tolist(), sides, strict=True)])
    longest = np.array([max(h0, w0) / unit, max(h1, w1) / unit])
    return CentredPair(pair.points + offset[:, None], offset, longest, pair.same_size[0])
