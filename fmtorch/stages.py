"""The protocols of the four stages: what anything must look like to take its place in a pipeline."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fmtorch.types import Correspondences, Estimate, Features


@runtime_checkable
class FeatureExtractor(Protocol):
    """An image (H, W) or (H, W, 3), uint8, RGB -> its local features."""

    def __call__(self, image: NDArray[np.uint8]) -> Features: ...


@runtime_checkable
class Matcher(Protocol):
    """The features of two images -> putative correspondences of that one pair."""

    def __call__(self, features0: Features, features1: Features) -> Correspondences: ...


@runtime_checkable
class Pruner(Protocol):
    """Correspondences -> the same, fewer of them surviving, or with a prior."""

    def __call__(self, c: Correspondences) -> Correspondences: ...


@runtime_checkable
class Estimator(Protocol):
    """Correspondences -> fundamental matrices."""

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate: ...
