"""Local features of exchangeable parts: detector x affine shape x orientation x descriptor."""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Features
from fmtorch.features.orientation import PatchFunction
from fmtorch.features.patches import ImagePyramid
from fmtorch.features.sift import as_grey


@runtime_checkable
class Detector(Protocol):
    """An image -> frames and scores."""

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]: ...


@runtime_checkable
class FrameStep(Protocol):
    """An image and frames -> the same frames with another shape or orientation."""

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 3"]: ...


@runtime_checkable
class Descriptor(Protocol):
    """An image and frames -> a descriptor of each."""

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]: ...


@dataclasses.dataclass(frozen=True)
class NetworkDescriptor:
    """Descriptors of 32 x 32 patches by a network, such as HardNet or L2-Net.

    network: patches (N, 1, 32, 32) -> (N, D). dimensions: D, for images without keypoints.
    """

    network: PatchFunction
    dimensions: int = 128

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        """Descriptors of the frames."""
        if len(lafs) == 0:
            return lafs.new_zeros(0, self.dimensions)
        return self.network(pyramid.extract(lafs)).to(lafs)


@dataclasses.dataclass(frozen=True)
class LocalFeature:
    """Detects frames, gives them shape and orientation, describes them; an instance may be used by several threads.

    shape, orientation: None keeps the detector's. device: where patches are cut and handed to the networks; on "cpu"
    through OpenCV. Of two instances with equal `detection` the frames are equal.
    """

    detector: Detector
    descriptor: Descriptor
    shape: FrameStep | None = None
    orientation: FrameStep | None = None
    device: str = "cpu"

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image; none, with N = 0, where nothing is found.

        Raises ValueError for another type, shape or an empty image, and what a network says of its file.
        """
        lafs, scores = self.detect(image)
        size = torch.tensor(image.shape[:2], dtype=torch.int64)
        return Features(lafs=lafs, scores=scores, descriptors=self.describe(image, lafs), image_size=size)

    @property
    def detection(self) -> tuple[object, ...]:
        """The parts that define frames and scores."""
        return self.detector, self.shape, self.orientation, self.device

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        """Frames in kornia's convention, with shape and orientation, and the detector's scores."""
        lafs, scores = self.detector.detect(image)
        steps = [step for step in (self.shape, self.orientation) if step is not None]
        if steps and len(lafs):
            pyramid, lafs = self._pyramid(image), lafs.to(self.device)
            for step in steps:
                lafs = step(pyramid, lafs)
        return lafs.cpu(), scores.cpu()

    def describe(self, image: NDArray[np.uint8], lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        """A descriptor of each frame."""
        return self.descriptor(self._pyramid(image), lafs.to(self.device)).cpu()

    def _pyramid(self, image: NDArray[np.uint8]) -> ImagePyramid:
        grey = as_grey(image)
        if self.device == "cpu":
            return ImagePyramid(grey)
        return ImagePyramid(torch.from_numpy(grey).to(self.device).float() / 255)
