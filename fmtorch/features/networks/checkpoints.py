"""Weights of patch networks from files: own checkpoints, kornia's and the authors' state_dicts, TorchScript."""

from __future__ import annotations

import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fmtorch.features.networks.descriptors import GeoDesc, HardNet, HardNetFast, L2Net
from fmtorch.features.networks.geometry import AffNet, AffNetFast, OriNet

ARCHITECTURES: dict[str, type[nn.Module]] = {
    "hardnet": HardNet, "hardnet_fast": HardNetFast, "l2net": L2Net, "geodesc": GeoDesc,
    "affnet": AffNet, "affnet_fast": AffNetFast, "orinet": OriNet,
}  # fmt: skip
DESCRIPTORS = ("hardnet", "hardnet_fast", "l2net", "geodesc")


def build(architecture: str, **options: Any) -> nn.Module:
    """An untrained network; options as its class takes them. Raises ValueError for an unknown name."""
    if architecture not in ARCHITECTURES:
        raise ValueError(f"no patch network {architecture!r}; there are: {', '.join(ARCHITECTURES)}")
    return ARCHITECTURES[architecture](**options)


def read_checkpoint(path: Path | str) -> dict[str, Any]:
    """A checkpoint as a dictionary with a ``state_dict``; nothing in the file is executed.

    A bare state_dict, TorchScript and {"state_dict": ...} with whatever stands beside it are read.
    Raises FileNotFoundError, or ValueError naming the file where it is none of these.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    try:
        content: Any = (
            _script_state(path) if _is_script(path) else torch.load(path, map_location="cpu", weights_only=True)
        )
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError) as error:
        raise ValueError(f"{path} is neither a state_dict nor TorchScript: {error}") from error
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        return dict(content)
    if isinstance(content, Mapping) and content and all(isinstance(value, Tensor) for value in content.values()):
        return {"state_dict": dict(content)}
    raise ValueError(f"{path} holds no state_dict")


def _is_script(path: Path) -> bool:
    """Whether a file is a TorchScript archive."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def _script_state(path: Path) -> dict[str, Tensor]:
    """The state_dict of TorchScript; in old files the statistics of batch norms are attributes and no buffers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        script = torch.jit.load(str(path), map_location="cpu")  # type: ignore[no-untyped-call]
    state = dict(script.state_dict())
    for name, module in script.named_modules():
        for key in ("running_mean", "running_var"):
            if isinstance(getattr(module, key, None), Tensor):
                state.setdefault(f"{name}.{key}", getattr(module, key))
    return state


def load_weights(network: nn.Module, path: Path | str) -> dict[str, Any]:
    """Load a file into a network, strictly; returns what the file says beside the weights.

    Convolutions with a bias and batch norms with scale and shift, as ports of L2-Net have them, are folded into batch
    norms without. Raises ValueError with the keys that do not fit.
    """
    content = read_checkpoint(path)
    state = _folded({str(k).removeprefix("module."): v for k, v in content.pop("state_dict").items()}, network)
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise ValueError(f"{path} holds no {type(network).__name__}: {error}") from error
    return content


def _folded(state: dict[str, Tensor], network: nn.Module) -> dict[str, Tensor]:
    """The same function in the keys of `network`: b, gamma and beta of a layer move into the running statistics.

    gamma (x + b - m) / sqrt(v + e) + beta = (x - m') / sqrt(v' + e') with v' + e' = (v + e) / gamma^2 and
    m' = m - b - beta sqrt(v + e) / gamma.
    """
    expected = network.state_dict()
    state = {k: v for k, v in _with_dropout(state).items() if k in expected or not k.endswith("num_batches_tracked")}
    for name, module in network.named_modules():
        if not isinstance(module, nn.BatchNorm2d):
            continue
        stem, _, index = name.rpartition(".")
        before = f"{stem}.{int(index) - 1}" if f"{stem}.{int(index) - 1}.weight" in expected else ""
        bias = state.pop(f"{before}.bias", None) if f"{before}.bias" not in expected else None
        gamma, beta = state.pop(f"{name}.weight", None), state.pop(f"{name}.bias", None)
        if (bias is None and gamma is None and beta is None) or f"{name}.running_var" not in state:
            continue
        mean, var = state[f"{name}.running_mean"].double(), state[f"{name}.running_var"].double() + module.eps
        gamma = torch.ones_like(var) if gamma is None else gamma.double()
        if not bool((gamma > 0).all()):
            raise ValueError(f"{name}.weight has scales that are not positive: they cannot be folded away")
        mean = (
            mean - (0 if bias is None else bias.double()) - (0 if beta is None else beta.double() * var.sqrt() / gamma)
        )
        state[f"{name}.running_mean"] = mean.float()
        state[f"{name}.running_var"] = (var / gamma.square() - module.eps).float()
    optional = [name for name in expected if name == "pixel_mean" or name.endswith("num_batches_tracked")]
    return {name: expected[name] for name in optional} | state


def _with_dropout(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Keys of a network whose last convolution is layer 18, for want of a dropout layer, as where there is one."""
    if "features.18.weight" not in state:
        return state
    moved = {"18": "19", "19": "20"}
    parts = ((name.split("."), value) for name, value in state.items())
    return {".".join([stem, moved.get(index, index), *rest]): value for (stem, index, *rest), value in parts}
