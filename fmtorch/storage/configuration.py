"""What defines the results of a feature extractor, as plain values: its options, learned files, code, libraries."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import importlib.metadata
import platform
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import torch

from fmtorch.core.version import __version__
from fmtorch.storage.code import code_digest, digest

LIBRARIES = ("numpy", "torch", "kornia", "onnxruntime")  # and OpenCV, which has several names as a package
VARIANTS = {"onnxruntime": ("onnxruntime-gpu", "onnxruntime-directml")}  # other packages of the same library


def configuration(part: object) -> Any:
    """A part of a pipeline as plain values that JSON can hold; equal values mean equal results.

    A dataclass is its class, its code and the code that it imports from its own package (`code_digest`), and its fields
    (not those with ``compare=False``); an object with an attribute `identity` is that attribute in place of the fields;
    a class is its name and code; a `Path` is the digest of the file; tensors and networks are the digests of their
    values. Raises TypeError for anything that does not say what defines it, and OSError for a file that cannot be read.
    """
    return _plain(part, code=True)


def _plain(part: object, code: bool) -> Any:
    """The `configuration` of a part, or all of it but the digests of code."""
    if part is None or isinstance(part, bool | int | float | str):
        return part
    if isinstance(part, Path):
        return {"file": file_digest(part)}
    if isinstance(part, Mapping):
        return {str(key): _plain(value, code) for key, value in part.items()}
    if isinstance(part, list | tuple):
        return [_plain(value, code) for value in part]
    if isinstance(part, type):
        return _class(part, code)
    if isinstance(part, torch.Tensor):
        values = part.detach().cpu().contiguous()
        return {"tensor": [str(part.dtype), list(part.shape), digest(values.reshape(-1).view(torch.uint8).numpy())]}
    return {**_options(part, code), **_class(type(part), code)}


def learned(part: object) -> list[str]:
    """Digests of the learned files and networks that a part of a pipeline uses, sorted; of a network's weights one.

    None for a part that does not say what defines it, or whose file cannot be read: it tells so itself when used.
    """
    try:
        described = _plain(part, code=False)
    except (TypeError, OSError):
        return []
    return sorted(set(_learned(described)))


def _learned(value: Any) -> Iterator[str]:
    if isinstance(value, list):
        for entry in value:
            yield from _learned(entry)
    elif isinstance(value, dict):
        for key, entry in value.items():
            if key == "file" and isinstance(entry, str):
                yield entry
            elif key == "weights":
                yield digest(repr(entry).encode())
            else:
                yield from _learned(entry)


def _options(part: object, code: bool) -> dict[str, Any]:
    if hasattr(part, "identity"):
        return {"identity": _plain(part.identity, code)}
    if dataclasses.is_dataclass(part):
        return {f.name: _plain(getattr(part, f.name), code) for f in dataclasses.fields(part) if f.compare}
    if isinstance(part, torch.nn.Module):
        return {"network": repr(part), "weights": _plain(part.state_dict(), code)}
    raise TypeError(
        f"{type(part).__module__}.{type(part).__qualname__} does not say what defines its results; "
        "make it a dataclass, or give it an attribute `identity` of plain values"
    )


def _class(kind: type, code: bool) -> dict[str, str]:
    name = {"class": f"{kind.__module__}.{kind.__qualname__}"}
    return {**name, "code": code_digest(kind.__module__)} if code else name


@functools.cache
def environment() -> dict[str, str]:
    """Versions of what computes, and the processor's instruction set, on which the last bits of a result depend."""
    versions = {name: _version(name) for name in LIBRARIES}
    processor = f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
    return {"fmtorch": __version__, "opencv": cv2.__version__, **versions, "processor": processor}


def libraries(others: Iterable[str] = ()) -> dict[str, str]:
    """Versions of the libraries that decide numbers, and of other packages; of a build for some device its version."""
    versions = {"opencv": cv2.__version__, **{name: _version(name) for name in (*LIBRARIES, *others)}}
    return {name: version.partition("+")[0] for name, version in sorted(versions.items())}


def _version(package: str) -> str:
    for name in (package, *VARIANTS.get(package, ())):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            return importlib.metadata.version(name)
    return str(getattr(importlib.import_module(package), "__version__", "unknown"))


def file_digest(path: Path) -> str:
    """The hex digest of a file's contents, read once unless the file is changed. Raises OSError."""
    return _file_digest(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=256)
def _file_digest(path: Path, modified: int) -> str:
    return digest(path.read_bytes())
