"""ONNX files opened for inference on a CPU."""

import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

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


def pretrained(load: Callable[[], Network], name: str, publisher: str, file: str, kept_as: str = "") -> Network:
    """The network that a library's own loader fetches once and keeps in torch's hub folder.
    file: of the publisher. kept_as: where the loader looks for it, where that is another name. Raises ConnectionError,
    saying what to put where, where it cannot be fetched."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of each attempt; the last one's error says it all
            network = load()
    except (RuntimeError, OSError) as error:
        cause = str(error.__cause__ or error).splitlines()[0]
        raise ConnectionError(
            f"the weights of {name} cannot be loaded ({cause}). They are not part of this project: run once with "
            f"access to {publisher}, or copy its {file} to "
            f"{Path(torch.hub.get_dir()) / 'checkpoints' / (kept_as or file)}"
        ) from error
    return network
