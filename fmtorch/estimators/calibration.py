"""What is known of the focal lengths of a pair before its matches are looked at."""

from __future__ import annotations

import math
from typing import NamedTuple

from fmtorch.geometry.arithmetic import logarithm_kernel
from fmtorch.jit.kernel import Array

EXACT = 0.02  # relative deviation below which a focal length counts as exactly known


class Calibration(NamedTuple):
    """Measured focal lengths of two images of square pixels and central principal points.

    focals: px. deviations: relative standard deviations, 0 of a calibration, infinite where a focal length is unknown.
    shared: whether both are one, in units of the longer sides of the images.
    """

    focals: tuple[float, float]
    deviations: tuple[float, float]
    shared: bool

    @property
    def exact(self) -> bool:
        """Whether both are exactly known."""
        return max(self.deviations) < EXACT

    def logarithms(self, longest: tuple[float, float]) -> tuple[float, float]:
        """Of the focal lengths in units of the longer sides (px); 0 of unknown ones."""
        f0, f1 = (
            float(logarithm_kernel(f / side)) if math.isfinite(s) else 0.0
            for f, s, side in zip(self.focals, self.deviations, longest, strict=True)
        )
        return f0, f1


def calibration_of(focal: Array, shared: bool) -> Calibration | None:
    """The calibration of a pair from a row of `Correspondences.focal` (2, 2); None where nothing is known."""
    (f0, s0), (f1, s1) = focal.tolist()
    if not shared and math.isinf(s0) and math.isinf(s1):
        return None
    return Calibration((f0, f1), (s0, s1), shared)
