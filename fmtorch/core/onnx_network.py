"""ONNX files opened for inference on a CPU."""

import functools
import hashlib
import os
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from unittest import mock

import torch


class NetworkFileError(ValueError):
    """A network file that is absent, unreadable or of another shape; the message names it and what makes it."""


def onnx_session(path: Path | str, threads: int, hint: str) -> Any:
    """An ``onnxruntime.InferenceSession`` on CPU, which several threads may use: one for each file and thread count.
    threads: of one operator; operators run one after the other. hint: what makes such a file, for the errors. A file
    that changed is opened again. Raises NetworkFileError where it is absent or cannot be run."""
    path = Path(path).absolute()
    if not path.is_file():
        raise NetworkFileError(f"{path} does not exist: {hint}")
    try:
        return _opened(str(path), path.stat().st_mtime_ns, threads)
    except Exception as error:  # the runtime has a dozen kinds, and where its message is no text, UnicodeDecodeError
        raise NetworkFileError(f"{path} is no ONNX network that can be run ({error}): {hint}") from error


@functools.lru_cache(maxsize=16)
def _opened(path: str, modified: int, threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


# Networks that other libraries fetch

Network = TypeVar("Network")
PUBLISHED = {  # SHA-256 of the publishers' files; DISK's epipolar-save.pth alone is not checked
    "aliked-n16.pth": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
    "aliked-n16rot.pth": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    "aliked-n32.pth": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
    "aliked-t16.pth": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
    "depth-save.pth": "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
    "aliked_lightglue.pth": "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    "disk_lightglue.pth": "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
    "xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    "xfeat-lighterglue.pt": "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
}


def pretrained(load: Callable[[], Network], name: str, publisher: str, file: str, kept_as: str = "") -> Network:
    """The network that a library's own loader fetches once and keeps in torch's hub folder; no code of it is run.
    file: of the publisher. kept_as: where the loader looks for it, where that is another name. Raises ConnectionError,
    saying what to put where, where it cannot be fetched, and NetworkFileError for another file than the publisher's."""
    path = Path(torch.hub.get_dir()) / "checkpoints" / (kept_as or file)
    before = path.is_file() and _expect_published(path, file)
    try:
        with warnings.catch_warnings(), mock.patch.dict(os.environ, TORCH_FORCE_WEIGHTS_ONLY_LOAD="1"):
            warnings.simplefilter("ignore")  # of each attempt; the last one's error says it all
            network = load()
    except (RuntimeError, OSError, pickle.UnpicklingError) as error:
        cause = str(error.__cause__ or error).splitlines()[0]
        raise ConnectionError(
            f"the weights of {name} cannot be loaded ({cause}). They are not part of this project: run once with "
            f"access to {publisher}, or copy its {file} to {path}"
        ) from error
    if not before and path.is_file():
        _expect_published(path, file)
    return network


def _expect_published(path: Path, file: str) -> bool:
    with path.open("rb") as content:
        digest = hashlib.file_digest(content, "sha256").hexdigest()
    if digest != PUBLISHED.get(file, digest):
        raise NetworkFileError(f"{path} is not the published {file}: its SHA-256 is {digest}; delete it")
    return True
