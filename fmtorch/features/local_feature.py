"""Local features of exchangeable parts: detector x affine shape x orientation x descriptor."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core import Features, Within
from fmtorch.features.frames import DominantGradient, NetworkOrientation, NetworkShape, PatchFunction
from fmtorch.features.hessian import HessianDetector
from fmtorch.features.onnx_network import PatchNetwork, network_file
from fmtorch.features.patches import Image, ImagePyramid
from fmtorch.features.sift import SIFT, PatchSIFT, RootSIFTPCA, as_grey


@runtime_checkable
class Detector(Protocol):
    """An image -> frames and scores."""

    def detect(self, image: Image) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]: ...


FrameStep = Callable[[ImagePyramid, Tensor], Tensor]
"""An image and frames (n, 2, 3) -> the same frames with another shape or orientation."""
Descriptor = Callable[[ImagePyramid, Tensor], Tensor]
"""An image and frames (n, 2, 3) -> a descriptor of each (n, d)."""


@dataclasses.dataclass(frozen=True)
class NetworkDescriptor:
    """Descriptors of 32 x 32 patches by a network, such as HardNet or L2-Net.
    network: patches (N, 1, 32, 32) -> (N, D). dimensions: D, for images without keypoints."""

    network: PatchFunction
    dimensions: int = 128

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        """Descriptors of the frames."""
        return self.network(pyramid.extract(lafs)).to(lafs) if len(lafs) else lafs.new_zeros(0, self.dimensions)


@dataclasses.dataclass(frozen=True)
class LocalFeature:
    """Detects frames, gives them shape and orientation, describes them; an instance may be used by several threads.
    shape, orientation: None keeps the detector's. Of two instances with equal `detection` the frames are equal."""

    detector: Detector
    descriptor: Descriptor
    shape: FrameStep | None = None
    orientation: FrameStep | None = None

    def __call__(self, image: Image) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image; none, with N = 0, where nothing is found.
        Raises ValueError for another type, shape or an empty image, and what a network says of its file."""
        lafs, scores = self.detect(image)
        size = torch.tensor(image.shape[:2], dtype=torch.int64)
        return Features(lafs=lafs, scores=scores, descriptors=self.describe(image, lafs), image_size=size)

    @property
    def detection(self) -> tuple[object, ...]:
        """The parts that define frames and scores."""
        return self.detector, self.shape, self.orientation

    def detect(self, image: Image) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]:
        """Frames in kornia's convention, with shape and orientation, and the detector's scores."""
        lafs, scores = self.detector.detect(image)
        steps = [step for step in (self.shape, self.orientation) if step is not None]
        if steps and len(lafs):
            pyramid = ImagePyramid(as_grey(image))
            for step in steps:
                lafs = step(pyramid, lafs)
        return lafs, scores

    def describe(self, image: Image, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
        """A descriptor of each frame."""
        return self.descriptor(ImagePyramid(as_grey(image)), lafs)


Part = TypeVar("Part")
Options = Mapping[str, Any]
Choice = str | Options
"""A part's name, or a mapping with its `name` and options."""


def local_feature(
    detector: Choice,
    descriptor: Choice,
    shape: Choice | None = None,
    orientation: Choice | None = None,
    max_features: Annotated[int, Within(1)] = 8000,
    precision: str = "fp32",
    threads: int = 1,
) -> LocalFeature:
    """A `LocalFeature` of named parts.
    detector: `dog` (options of `SIFT`) or `hessian` (options of `HessianDetector`), at most `max_features` of them.
    shape: None, `affnet` or `affnet_fast`. orientation: None for the detector's, `dominant_gradient` or `orinet`.
    descriptor: `sift`, `rootsift`, `dspsift` (options of `PatchSIFT`), `rootsiftpca` (of `RootSIFTPCA`), `l2net`,
    `geodesc`, `hardnet` or `hardnet_fast`. A part that is a network takes the option `network`, the path of another
    ONNX file than the shipped one. precision: of the networks, fp32 or int8. threads: of each network. Raises
    ValueError for an unknown name or option, naming those there are. Networks are read when first used."""
    if precision not in ("fp32", "int8"):
        raise ValueError(f"precision={precision}: it must be fp32 or int8")

    def by(part: Callable[[PatchFunction], Part], name: str) -> Callable[..., Part]:
        return lambda network=name: part(PatchNetwork(network_file(network, precision), threads=threads))

    kinds: dict[str, Callable[..., Detector]] = {"dog": SIFT, "hessian": HessianDetector}
    detectors = {name: functools.partial(kind, max_features=max_features) for name, kind in kinds.items()}
    shapes: dict[str, Callable[..., FrameStep]] = {name: by(NetworkShape, name) for name in ("affnet", "affnet_fast")}
    orinet = by(NetworkOrientation, "orinet")
    orientations: dict[str, Callable[..., FrameStep]] = {"dominant_gradient": DominantGradient, "orinet": orinet}
    rooted = functools.partial(PatchSIFT, root=True)
    plain: dict[str, Callable[..., Descriptor]] = {"sift": PatchSIFT, "rootsift": rooted, "dspsift": PatchSIFT}
    networks = {name: by(NetworkDescriptor, name) for name in ("l2net", "geodesc", "hardnet", "hardnet_fast")}
    descriptors: dict[str, Callable[..., Descriptor]] = {**plain, "rootsiftpca": RootSIFTPCA, **networks}
    shape_step = None if shape is None else _part("shape", shape, shapes)
    turn_step = None if orientation is None else _part("orientation", orientation, orientations)
    ends = _part("detector", detector, detectors), _part("descriptor", descriptor, descriptors)
    return LocalFeature(*ends, shape_step, turn_step)


def _part(kind: str, choice: Choice, known: Mapping[str, Callable[..., Part]]) -> Part:
    options = {"name": choice} if isinstance(choice, str) else dict(choice)
    name = options.pop("name", None)
    if name not in known:
        raise ValueError(f"{kind}={name}: there is no such part; there are: {', '.join(known)}")
    try:
        return known[str(name)](**options)
    except TypeError as error:
        raise ValueError(f"{kind}={name}: {error}") from error
