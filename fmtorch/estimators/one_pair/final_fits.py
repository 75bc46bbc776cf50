"""`final_fits` on the arrays of one pair: values; gradients are the tensor form's."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from fmtorch.estimators import final_fits
from fmtorch.estimators.one_pair.models import Selection
from fmtorch.estimators.one_pair.pair import Array, OnePair
from fmtorch.geometry.eight_point_kernels import weighted_eight_point


class Fit(NamedTuple):
    """As `final_fits.Fit`: F (3, 3), the model (3, 3) at which the gradient is taken, the matches (n,) that count."""

    F: Array
    at: Array
    counted: Array


@runtime_checkable
class FinalFit(Protocol):
    """As `final_fits.FinalFit`."""

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """The estimate from the selected model and its inliers (n,)."""
        ...


class NoFit:
    """As `final_fits.NoFit`."""

    def __init__(self, part: final_fits.NoFit) -> None:
        pass

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """As `FinalFit.value`."""
        return Fit(selection.matrices, selection.matrices, inliers)


class LeastSquares:
    """As `final_fits.LeastSquares`."""

    def __init__(self, part: final_fits.LeastSquares) -> None:
        self.part = part

    def value(self, selection: Selection, pair: OnePair, inliers: Array) -> Fit:
        """As `FinalFit.value`."""
        weighted = self.part.weighted and pair.prior is not None
        weight = np.where(inliers, pair.weight if weighted else 1.0, 0.0)
        F = np.empty(9)
        fitted = weighted_eight_point(pair.points, weight, F)
        return Fit(F.reshape(3, 3) if fitted else selection.matrices, selection.matrices, inliers)
