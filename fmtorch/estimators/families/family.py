"""What the engine asks of a family of models.

Every model is a 3 x 3 matrix of nine entries that acts on a pair's normalised points, so that residuals, scores, pool
and stopping rule are written once; what differs is the family's: minimal samples, refinement, the fit.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

from fmtorch.compiling.arrays import Array
from fmtorch.estimators.pair import Pair
from fmtorch.geometry.residual_kernels import Residual


class Hypotheses(NamedTuple):
    """Models of one round in the order of their draws: F (m, 9) float32, and the draw (m,) that each is made of.

    draw: counted from `start`. sample: (size, s), the matches of the draws start, start + 1, ...
    """

    F: Array
    draw: Array
    sample: Array
    start: int


@runtime_checkable
class Family(Protocol):
    """A family of models. size: matches of a minimal sample."""

    size: ClassVar[int]

    def solve(self, pair: Pair, sample: Array, start: int) -> Hypotheses:
        """The models of the samples (size, s), which are the draws start, start + 1, ..."""
        ...


class FitScale(NamedTuple):
    """The last fit, at a pair's own noise.

    loss: its robust loss. sigmas_of_median: the standard deviation of a coordinate, in medians of inliers' residuals.
    scale_sigmas: the scale of the loss in these; it is within smallest_px and largest_px, and default_px where too few
    inliers tell the noise. by_prior: whether a match counts by its prior, too, not by its noise alone.
    """

    loss: str = "truncated"
    sigmas_of_median: float = 1.4826
    scale_sigmas: float = 2.0
    smallest_px: float = 0.3
    largest_px: float = 2.0
    default_px: float = 1.5
    by_prior: bool = True


class Loss(NamedTuple):
    """A robust loss of the Sampson distance. name: of `geometry.KERNELS`. scale: px, of a match of usual noise."""

    name: str
    scale: float


class Steps(NamedTuple):
    """Of Levenberg-Marquardt. damping: of the first step. tolerance: None, or the share of its cost by which a step
    must lower it, if the fit is to go on."""

    iterations: int
    damping: float
    tolerance: float | None = None


@runtime_checkable
class Estimated(Protocol):
    """What an estimate is. model: what it is called. residual: by which matches are judged."""

    model: ClassVar[str]
    residual: ClassVar[Residual]

    def to_pixels(self, F: Array, pair: Pair, out: Array) -> bool:
        """A model (9,) of normalised points as that of pixels, of unit norm -> out (3, 3); whether it is finite."""
        ...


@runtime_checkable
class Refining(Family, Estimated, Protocol):
    """A family whose models can be refined and fitted on their own."""

    fit_scale: ClassVar[FitScale]

    def refine(self, F: Array, pair: Pair, loss: Loss, steps: Steps) -> Array:
        """Models (k, 9) of least robust error nearby, on all matches by prior and noise; float64.

        One that cannot be refined is as it was.
        """
        ...

    def least_squares(self, F: Array, pair: Pair, weight: Array) -> Array:
        """The model (9,) fitted to weighted matches (n,); F (9,) where they determine none."""
        ...

    def step(self, F: Array, pair: Pair, weight: Array) -> Array:
        """The model (9,) after one Gauss-Newton step on weighted matches (n,); F (9,) where there is none."""
        ...
