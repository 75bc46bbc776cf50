"""What defines the results of a feature extractor, as plain values: its options, learned files, code, libraries."""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import importlib.metadata
import platform
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import torch

from fmtorch import __version__

LIBRARIES = ("numpy", "torch", "kornia", "onnxruntime")  # and OpenCV, which has several names as a package


def configuration(part: object) -> Any:
    """A part of a pipeline as plain values that JSON can hold; equal values mean equal results.

    A dataclass is its class, its code and the code that it imports from its own package, and its fields (not those with
    ``compare=False``); an object with an attribute `identity` is that attribute in place of the fields; a class is its
    name and code; a `Path` is the digest of the file; tensors and networks are the digests of their values.
    Raises TypeError for anything that does not say what defines it, and OSError for a file that cannot be read.
    """
    if part is None or isinstance(part, bool | int | float | str):
        return part
    if isinstance(part, Path):
        return {"file": _file_digest(part, part.stat().st_mtime_ns)}
    if isinstance(part, Mapping):
        return {str(key): configuration(value) for key, value in part.items()}
    if isinstance(part, list | tuple):
        return [configuration(value) for value in part]
    if isinstance(part, type):
        return _class(part)
    if isinstance(part, torch.Tensor):
        values = part.detach().cpu().contiguous()
        return {"tensor": [str(part.dtype), list(part.shape), _digest(values.reshape(-1).view(torch.uint8).numpy())]}
    return {**_options(part), **_class(type(part))}


def learned(part: object) -> list[str]:
    """Digests of the learned files and networks that a part of a pipeline uses, sorted; of a network's weights one.

    None for a part that does not say what defines it, or whose file cannot be read: it tells so itself when used.
    """
    try:
        whole = configuration(part)
    except (TypeError, OSError):
        return []
    return sorted(set(_learned(whole)))


def _learned(value: Any) -> Iterator[str]:
    if isinstance(value, list):
        for entry in value:
            yield from _learned(entry)
    elif isinstance(value, dict):
        for key, entry in value.items():
            if key == "file" and isinstance(entry, str):
                yield entry
            elif key == "weights":
                yield _digest(repr(entry).encode())
            else:
                yield from _learned(entry)


def _options(part: object) -> dict[str, Any]:
    if hasattr(part, "identity"):
        return {"identity": configuration(part.identity)}
    if dataclasses.is_dataclass(part):
        return {f.name: configuration(getattr(part, f.name)) for f in dataclasses.fields(part) if f.compare}
    if isinstance(part, torch.nn.Module):
        return {"network": repr(part), "weights": configuration(part.state_dict())}
    raise TypeError(
        f"{type(part).__module__}.{type(part).__qualname__} does not say what defines its results; "
        "make it a dataclass, or give it an attribute `identity` of plain values"
    )


def _class(kind: type) -> dict[str, str]:
    return {"class": f"{kind.__module__}.{kind.__qualname__}", "code": _code_digest(kind.__module__)}


@functools.cache
def environment() -> dict[str, str]:
    """Versions of what computes, and the processor's instruction set, on which the last bits of a result depend."""
    versions = {name: importlib.metadata.version(name) for name in LIBRARIES}
    processor = f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
    return {"fmtorch": __version__, "opencv": cv2.__version__, **versions, "processor": processor}


@functools.cache
def _code_digest(module: str) -> str:
    """The digest of a module's source and of all modules of its own top-level package that it imports, at any depth.

    Of a module of `LIBRARIES`, whose versions `environment` tells, the digest of its source alone.
    """
    file = getattr(sys.modules[module], "__file__", None)
    if file is None:
        raise TypeError(f"the code of {module} is in no file, so its changes cannot be noticed")
    package = module.partition(".")[0]
    home = getattr(sys.modules.get(package), "__file__", None)
    root = Path(home).parents[1] if home and "." in module and package not in LIBRARIES else None
    sources: dict[str, bytes] = {}
    waiting = [(module, Path(file))]
    while waiting:
        name, path = waiting.pop()
        if name in sources:
            continue
        sources[name] = path.read_bytes()
        if root is not None:
            named = (n for n in _imported(sources[name]) if n.partition(".")[0] == package)
            waiting += [(n, found) for n in named if (found := _source_file(root, n))]
    return _digest("".join(f"{name} {_digest(sources[name])}\n" for name in sorted(sources)).encode())


def _imported(source: bytes) -> set[str]:
    """Dotted names that a source may import: modules, and what is taken from them, which may be modules too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.update((node.module, *(f"{node.module}.{alias.name}" for alias in node.names)))
    return names


def _source_file(root: Path, module: str) -> Path | None:
    """The file of a module below `root`; None where the name is not a module's."""
    path = root.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


@functools.lru_cache(maxsize=256)
def _file_digest(path: Path, modified: int) -> str:
    return _digest(path.read_bytes())


def _digest(data: Any) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
