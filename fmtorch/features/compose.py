"""Local features from the names of their parts, as presets give them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fmtorch.core.options import Within
from fmtorch.features.affine_shape import NetworkShape
from fmtorch.features.hessian import HessianDetector
from fmtorch.features.local_feature import Descriptor, Detector, FrameStep, LocalFeature, NetworkDescriptor
from fmtorch.features.orientation import DominantGradient, NetworkOrientation, PatchFunction
from fmtorch.features.patch_sift import PatchSIFT
from fmtorch.features.rootsift_pca import RootSIFTPCA
from fmtorch.features.sift import SIFT

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
    device: str = "cpu",
) -> LocalFeature:
    """A `LocalFeature` of named parts.

    detector: `dog` (options of `SIFT`) or `hessian` (options of `HessianDetector`), at most `max_features` of them.
    shape: None, `affnet` or `affnet_fast`. orientation: None for the detector's, `dominant_gradient` or `orinet`.
    descriptor: `sift`, `rootsift`, `dspsift` (options of `PatchSIFT`), `rootsiftpca` (of `RootSIFTPCA`), `l2net`,
    `geodesc`, `hardnet` or `hardnet_fast`. A part that is a network takes the option `network`, the path of another
    ONNX file than the shipped one.
    precision: of the networks, fp32 or int8. threads: of each network. device: for torch, see `LocalFeature`.

    Raises ValueError for an unknown name or option, naming those there are. Networks are read when first used.
    """
    if precision not in ("fp32", "int8"):
        raise ValueError(f"precision={precision}: it must be fp32 or int8")
    load = functools.partial(_network, precision=precision, threads=threads)

    def by(part: Callable[[PatchFunction], Part], name: str) -> Callable[..., Part]:
        return lambda network=name: part(load(network))

    detectors: dict[str, Callable[..., Detector]] = {
        "dog": functools.partial(SIFT, max_features=max_features),
        "hessian": functools.partial(HessianDetector, max_features=max_features),
    }
    shapes: dict[str, Callable[..., FrameStep]] = {name: by(NetworkShape, name) for name in ("affnet", "affnet_fast")}
    orientations: dict[str, Callable[..., FrameStep]] = {
        "dominant_gradient": DominantGradient,
        "orinet": by(NetworkOrientation, "orinet"),
    }
    descriptors: dict[str, Callable[..., Descriptor]] = {
        "sift": PatchSIFT,
        "rootsift": functools.partial(PatchSIFT, root=True),
        "dspsift": PatchSIFT,
        "rootsiftpca": RootSIFTPCA,
        **{name: by(NetworkDescriptor, name) for name in ("l2net", "geodesc", "hardnet", "hardnet_fast")},
    }
    return LocalFeature(
        detector=_part("detector", detector, detectors),
        descriptor=_part("descriptor", descriptor, descriptors),
        shape=None if shape is None else _part("shape", shape, shapes),
        orientation=None if orientation is None else _part("orientation", orientation, orientations),
        device=device,
    )


def _part(kind: str, choice: Choice, known: Mapping[str, Callable[..., Part]]) -> Part:
    options = {"name": choice} if isinstance(choice, str) else dict(choice)
    name = options.pop("name", None)
    if name not in known:
        raise ValueError(f"{kind}={name}: there is no such part; there are: {', '.join(known)}")
    try:
        return known[str(name)](**options)
    except TypeError as error:
        raise ValueError(f"{kind}={name}: {error}") from error


def _network(name: str, precision: str, threads: int) -> PatchFunction:
    """The network of models/ under this name."""
    from fmtorch.features.onnx_network import PatchNetwork, network_file

    file: Path = network_file(name, precision)
    network: PatchFunction = PatchNetwork(file, threads=threads)
    return network
