"""Photographs described for matching: features of each as it was reduced, and what leads back to it."""

from __future__ import annotations

import dataclasses

from jaxtyping import Float
from torch import Tensor

from fmtorch.core.grey_pyramid import GreyPyramid, grey_pyramid
from fmtorch.core.no_features import NoFeatures
from fmtorch.core.stages import ImageMatcher
from fmtorch.core.types import Features
from fmtorch.data.images import to_grey
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pipeline.reduced_images import Image, reduced_image, to_original


@dataclasses.dataclass(frozen=True, eq=False)
class Described:
    """A photograph's features in pixels of it as it was reduced, the scale of that in x and y, and its size (h, w).

    seconds: that describing it takes or took. pyramid: its grey levels, for pruners that look at them. image: reduced,
    for a matcher that takes the images themselves, and has no features.
    """

    features: Features
    scale: Float[Tensor, " xy"]
    size: tuple[int, int]
    seconds: float
    pyramid: GreyPyramid | None = None
    image: Image | None = None

    @property
    def points(self) -> Float[Tensor, "n 2"]:
        """The keypoints in pixels of the photograph."""
        return to_original(self.features.keypoints, self.scale.to(self.features.keypoints))


def describe(pipeline: Pipeline, image: Image, longest_side: int) -> Described:
    """The features of a photograph, for `relate`; see `match`."""
    reduced, scale = reduced_image(image, longest_side)
    itself = isinstance(pipeline.matcher, ImageMatcher)
    features, seconds = (NoFeatures()(reduced), 0.0) if itself else pipeline.extract(reduced)
    pyramid = grey_pyramid(to_grey(reduced)) if pipeline.looks_at_images else None
    return Described(features, scale, (image.shape[0], image.shape[1]), seconds, pyramid, reduced if itself else None)
