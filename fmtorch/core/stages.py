"""The protocols of the four stages: what anything must look like to take its place in a pipeline."""

from collections.abc import Callable
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.grey_pyramid import GreyPyramid
from fmtorch.core.types import Correspondences, Estimate, Features

PairImages: TypeAlias = tuple[GreyPyramid, GreyPyramid]


@runtime_checkable
class FeatureExtractor(Protocol):
    """An image (H, W) or (H, W, 3), uint8, RGB -> its local features."""

    def __call__(self, image: NDArray[np.uint8]) -> Features: ...


@runtime_checkable
class TwoStepExtractor(FeatureExtractor, Protocol):
    """An extractor whose two steps a cache keeps apart: extractors with the same detection share its results.

    Calling it equals ``describe(image, lafs)`` after ``lafs, scores = detect(image)``: a descriptor for each frame.
    """

    @property
    def detection(self) -> object:
        """What defines the frames and scores: parts, options, files (`fingerprint.configuration`)."""
        ...

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        """Local affine frames and their scores."""
        ...

    def describe(self, image: NDArray[np.uint8], lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        """The descriptors of the frames, which may be on the CPU."""
        ...


@runtime_checkable
class TimedExtractor(FeatureExtractor, Protocol):
    """An extractor that knows what its result costs, such as one that may have it already."""

    def timed(self, image: NDArray[np.uint8]) -> tuple[Features, float]:
        """The features, and the seconds that computing them takes or took."""
        ...


@runtime_checkable
class Matcher(Protocol):
    """The features of two images -> putative correspondences of that one pair."""

    def __call__(self, features0: Features, features1: Features) -> Correspondences: ...


@runtime_checkable
class ImageMatcher(Matcher, Protocol):
    """A matcher that takes the images themselves, and that refuses to be called with their features."""

    def match_images(self, image0: NDArray[np.uint8], image1: NDArray[np.uint8]) -> Correspondences:
        """Images (H, W) or RGB (H, W, 3), uint8 -> putative correspondences of that one pair, with image sizes."""
        ...


@runtime_checkable
class Pruner(Protocol):
    """Correspondences -> the same, fewer of them surviving, or with a prior."""

    def __call__(self, c: Correspondences) -> Correspondences: ...


@runtime_checkable
class ImagePruner(Pruner, Protocol):
    """A pruner that looks at the images, and that refuses to be called without them."""

    def with_images(self, c: Correspondences, images: Callable[[int], PairImages]) -> Correspondences:
        """images: of pair i of the batch, read when they are asked for."""
        ...


def pruned(pruner: Pruner, c: Correspondences, images: Callable[[int], PairImages]) -> Correspondences:
    """What a pruner makes of correspondences, with the images where it looks at them."""
    return pruner.with_images(c, images) if isinstance(pruner, ImagePruner) else pruner(c)


@runtime_checkable
class Estimator(Protocol):
    """Correspondences -> fundamental matrices."""

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate: ...


def model_of(estimator: Estimator) -> str:
    """What an estimator's matrices are, `Estimate.model`: fundamental, unless it says otherwise."""
    model: str = getattr(estimator, "model", "fundamental")
    return model
