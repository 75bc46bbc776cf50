"""Learned files of pruners: weights as safetensors, the backbone as ONNX; both state the network they belong to.

Reading one executes nothing of it: whoever reads the file builds the network, which has to be the one that it states.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from fmtorch.core.files import models_dir
from fmtorch.core.onnx_network import NetworkFileError, onnx_session
from fmtorch.pruning.networks.layers import Slots

SUFFIXES = {"torch": ".safetensors", "onnx": ".onnx"}  # of the file that each runtime reads
METADATA = "fmtorch"  # the one key of a file's metadata: several have no fixed order, and so no digest, in safetensors
INPUT, OUTPUT = "matches", "outputs"  # of an ONNX file: (1, channels, N) and (1, outputs, N)


class LearnedFile(NamedTuple):
    """What a learned file says beside its weights, kept in it as JSON.

    network: as of `stated_network`. temperature: by which log-odds are divided. notes: anything else.
    """

    network: Mapping[str, Any]
    temperature: float
    notes: Mapping[str, str]

    def metadata(self) -> dict[str, str]:
        """As a file's metadata; equal contents are equal bytes."""
        return {METADATA: json.dumps(self._asdict(), sort_keys=True)}


def learned_file(name: str | Path, runtime: str) -> Path:
    """Where the file of a name is that a runtime, "torch" or "onnx", reads.

    A name without a folder and a suffix is among the shipped models: "lc_f" is models/lc_f.onnx. Anything else is a
    path of the user's own, to which the suffix is added where it has none.
    """
    path = Path(name)
    if path.suffix in SUFFIXES.values():
        return path
    folder = models_dir() if len(path.parts) == 1 else path.parent
    return folder / f"{path.name}{SUFFIXES[runtime]}"


def stated_network(network: nn.Module) -> dict[str, Any]:
    """What a file states of its network: its class, and its options where it has an attribute of that name."""
    return {"class": type(network).__name__, "options": plain(getattr(network, "options", None))}


def plain(value: Any) -> Any:
    """A value as JSON gives it back."""
    return json.loads(json.dumps(value))


def load_weights(network: nn.Module, path: Path, hint: str) -> LearnedFile:
    """Load a safetensors file into a network, strictly.

    Args:
        network: built as the file states.
        path: the file.
        hint: what makes such a file, for the errors.

    Returns:
        What else the file says.

    Raises:
        NetworkFileError: the file is absent, unreadable, or of another network.
    """
    if not path.is_file():
        raise NetworkFileError(f"{path} does not exist: {hint}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata, state = file.metadata() or {}, {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise NetworkFileError(f"{path} is no safetensors file ({error}): {hint}") from error
    known = _checked(network, path, metadata)
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise NetworkFileError(f"{path} does not fit {type(network).__name__}: {error}") from error
    return known


class OnnxBackbone:
    """An ONNX file in the place of a network's `backbone`, for one pair without padding at a time."""

    def __init__(self, network: nn.Module, path: Path, hint: str, threads: int = 1) -> None:
        """Raises NetworkFileError for a file that is absent, cannot be run, or is of another network."""
        self.path, self.hint, self.threads = path, hint, threads
        session = self._session()
        by_verb = {"takes": session.get_inputs(), "gives": session.get_outputs()}
        shapes = {verb: [(a.name, a.type, len(a.shape)) for a in arguments] for verb, arguments in by_verb.items()}
        if shapes != {"takes": [(INPUT, "tensor(float)", 3)], "gives": [(OUTPUT, "tensor(float)", 3)]}:
            wanted = f"a pruner's file takes float {INPUT} (1, channels, N) and gives {OUTPUT} (1, K, N): {hint}"
            raise NetworkFileError(f"{path} takes {shapes['takes']} and gives {shapes['gives']}; {wanted}")
        self.file = _checked(network, path, session.get_modelmeta().custom_metadata_map)

    def __call__(self, x: Float[Tensor, "1 channels n"], slots: Slots) -> Float[Tensor, "1 outputs n"]:
        """The backbone's result, on x's device; computed on the CPU."""
        if slots.mask is not None or len(x) != 1:
            raise ValueError("an ONNX backbone takes one pair without padding at a time")
        array = x.detach().to("cpu", torch.float32).contiguous().numpy()
        return torch.from_numpy(self._session().run([OUTPUT], {INPUT: array})[0]).to(x.device)

    def _session(self) -> Any:
        return onnx_session(self.path, self.threads, self.hint)


def _checked(network: nn.Module, path: Path, metadata: Mapping[str, str]) -> LearnedFile:
    """What a file's metadata says. Raises NetworkFileError where it states another network, or none."""
    if METADATA not in metadata:
        raise NetworkFileError(f"{path} does not state its network: fmtorch.training.export makes such files")
    try:
        content = json.loads(metadata[METADATA])
        stated = LearnedFile(content["network"], float(content["temperature"]), content["notes"])
    except (ValueError, TypeError, KeyError) as error:
        raise NetworkFileError(f"{path}: its metadata cannot be read: {error!r}") from error
    if not (stated.temperature > 0 and math.isfinite(stated.temperature)):
        raise NetworkFileError(f"{path}: temperature {stated.temperature}; it has to be positive")
    expected = stated_network(network)
    if stated.network != expected:
        raise NetworkFileError(
            f"{path} holds {stated.network}, the preset names {expected}: take the file's options, or train this one"
        )
    return stated
