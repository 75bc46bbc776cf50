"""Local features of exchangeable parts: detector x affine shape x orientation x descriptor; patch networks by ONNX."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core import Features, NetworkFileError, Within, models_dir, onnx_session
from fmtorch.features.describe import PatchSIFT, RootSIFTPCA
from fmtorch.features.frames import DominantGradient, NetworkOrientation, NetworkShape, PatchFunction
from fmtorch.features.hessian import HessianDetector
from fmtorch.features.patches import Image, ImagePyramid
from fmtorch.features.sift import SIFT, as_grey

PRECISIONS = ("fp32", "int8")
PATCH_SHAPE = (1, 32, 32)
HINT = "scripts.patch_networks.export makes it from a checkpoint, scripts/download.py fetches authors' checkpoints"
HINT_INT8 = (
    "scripts.patch_networks.export precision=int8 makes it from a checkpoint, checkpoint=FILE, and patches that "
    "calibrate it, calibration=FOLDER (scripts.patch_networks.train leaves both)"
)


def network_file(name: str, precision: str = "fp32") -> Path:
    """Where the ONNX file of a network is among the shipped models: name.onnx, or name.int8.onnx.
    A name that ends in .onnx is a path of the user's own, left as it is. Raises ValueError for another precision."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision}; there are: {', '.join(PRECISIONS)}")
    if name.endswith(".onnx"):
        return Path(name)
    return models_dir() / (f"{name}.onnx" if precision == "fp32" else f"{name}.{precision}.onnx")


def _hint(path: Path | str) -> str:
    return HINT_INT8 if str(path).endswith(".int8.onnx") else HINT


class PatchNetwork:
    """A patch network from an ONNX file: float32 patches (N, 1, 32, 32) to (N, D).

    threads: of ONNX Runtime; one session a file and thread count serves all instances and threads of a process, is made
    at the first call and is not pickled. batch: patches are processed in portions of exactly this many, the last one
    filled up with zeros, so that a patch's result does not depend on how many or which patches came with it.

    Patches on a GPU are brought to the CPU and the result back; there is no other path."""

    def __init__(self, path: Path | str, *, threads: int = 1, batch: int = 256) -> None:
        if threads < 1 or batch < 1:
            raise ValueError(f"threads={threads}, batch={batch}: both must be at least 1")
        self.path, self.threads, self.batch = Path(path), threads, batch

    def __repr__(self) -> str:
        return f"PatchNetwork({str(self.path)!r}, threads={self.threads}, batch={self.batch})"

    def __call__(self, patches: Float[Tensor, "n 1 32 32"]) -> Float[Tensor, "n d"]:
        """The network's output for each patch, float32, on the patches' device.
        Raises NetworkFileError for a file that is absent, corrupt or of another shape, ValueError for other patches."""
        if patches.ndim != 4 or tuple(patches.shape[1:]) != PATCH_SHAPE:
            raise ValueError(f"patches are {tuple(patches.shape)}; a patch network takes (N, 1, 32, 32)")
        session, name, outputs = _session(self.path, self.threads)
        array = np.ascontiguousarray(patches.detach().to("cpu", torch.float32).numpy())
        result = np.zeros((len(array), outputs), np.float32)
        for start in range(0, len(array), self.batch):
            part = array[start : start + self.batch]
            filled = np.concatenate([part, np.zeros((self.batch - len(part), *PATCH_SHAPE), np.float32)])
            result[start : start + len(part)] = session.run(None, {name: filled})[0][: len(part)]
        return torch.from_numpy(result).to(patches.device)

    @property
    def identity(self) -> dict[str, object]:
        """What defines the results, for the feature cache. Raises NetworkFileError for a file that is absent."""
        if not self.path.is_file():
            raise NetworkFileError(f"{self.path} does not exist: {_hint(self.path)}")
        return {"file": self.path, "batch": self.batch}

    def open_file(self, device: torch.device) -> None:
        """Open the file now. Raises NetworkFileError where it cannot be used."""
        _session(self.path, self.threads)

    @property
    def outputs(self) -> int:
        """D, the length of an output; opens the file."""
        return _session(self.path, self.threads)[2]


def _session(path: Path, threads: int) -> tuple[Any, str, int]:
    session = onnx_session(path, threads, _hint(path))
    inputs, outputs = session.get_inputs(), session.get_outputs()
    shape = inputs[0].shape if len(inputs) == 1 else None
    fits = shape is not None and len(shape) == 4 and tuple(shape[1:]) == PATCH_SHAPE and not isinstance(shape[0], int)
    if not fits or inputs[0].type != "tensor(float)":
        actual = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
        wanted = f"a patch network takes float (N, 1, 32, 32), N free: {_hint(path)}"
        raise NetworkFileError(f"{path} takes {actual}; {wanted}")
    size = outputs[0].shape
    if len(outputs) != 1 or len(size) != 2 or not isinstance(size[1], int):
        wanted = f"a patch network gives (N, D): {_hint(path)}"
        raise NetworkFileError(f"{path} gives {[o.shape for o in outputs]}; {wanted}")
    return session, inputs[0].name, size[1]


@runtime_checkable
class Detector(Protocol):
    """An image -> frames and scores."""

    def detect(self, image: Image) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]: ...


FrameStep = Callable[[ImagePyramid, Tensor], Tensor]  # frames (n, 2, 3) -> others in shape or orientation
Descriptor = Callable[[ImagePyramid, Tensor], Tensor]  # frames (n, 2, 3) -> a descriptor of each (n, d)


@dataclasses.dataclass(frozen=True)
class NetworkDescriptor:
    """Descriptors of 32 x 32 patches by a network, such as HardNet or L2-Net.
    network: patches (N, 1, 32, 32) -> (N, D). dimensions: D, for images without keypoints."""

    network: PatchFunction
    dimensions: int = 128

    def __call__(self, pyramid: ImagePyramid, lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]:
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
        return self.descriptor(ImagePyramid(as_grey(image)), lafs)


Part = TypeVar("Part")
Options = Mapping[str, Any]
Choice = str | Options  # a part's name, or a mapping with its `name` and options


def local_feature(
    detector: Choice, descriptor: Choice, shape: Choice | None = None, orientation: Choice | None = None,
    max_features: Annotated[int, Within(1)] = 8000, precision: str = "fp32", threads: int = 1,
) -> LocalFeature:  # fmt: skip
    """A `LocalFeature` of named parts.
    detector: `dog` (options of `SIFT`) or `hessian` (options of `HessianDetector`), at most `max_features` of them.
    shape: None, `affnet` or `affnet_fast`. orientation: None for the detector's, `dominant_gradient` or `orinet`.
    descriptor: `sift`, `rootsift`, `dspsift` (options of `PatchSIFT`), `rootsiftpca` (of `RootSIFTPCA`), `l2net`,
    `geodesc`, `hardnet` or `hardnet_fast`. A part that is a network takes the option `network`, the path of another
    ONNX file than the shipped one. precision: of the networks, fp32 or int8. threads: of each network. Raises
    ValueError for an unknown name or option, naming those there are. Networks are read when first used."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision}: it must be {' or '.join(PRECISIONS)}")

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
