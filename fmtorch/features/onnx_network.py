"""Patch networks run by ONNX Runtime on CPU."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from fmtorch.core import NetworkFileError, models_dir, onnx_session

PRECISIONS = ("fp32", "int8")
PATCH_SHAPE = (1, 32, 32)
HINT = "scripts.patch_networks.export makes it from a checkpoint, scripts/download.py fetches authors' checkpoints"
HINT_INT8 = (
    "scripts.patch_networks.export precision=int8 makes it from a checkpoint, checkpoint=FILE, and patches that "
    "calibrate it, calibration=FOLDER (scripts.patch_networks.train leaves both)"
)


def network_file(name: str, precision: str = "fp32") -> Path:
    """Where the ONNX file of a network is among the shipped models: name.onnx, or name.int8.onnx.
    A name that ends in .onnx is a path of the user's own and stays as it is. Raises ValueError for another precision.
    """
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

    def __call__(self, patches: Float[torch.Tensor, "n 1 32 32"]) -> Float[torch.Tensor, "n d"]:
        """The network's output for each patch, float32, on the patches' device.
        Raises NetworkFileError for a file that is absent, corrupt or takes another shape, ValueError for patches of
        another shape."""
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
