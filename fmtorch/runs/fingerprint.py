"""The code that makes a result: the version of fmtorch, in a checkout its commit, and the sources of a user's parts."""

import ast
import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import torch

from fmtorch.core.failures import INSTALLED
from fmtorch.core.files import PACKAGE
from fmtorch.core.version import __version__

DIGITS = 12  # of a commit or digest that a version shows
GIT_SECONDS = 10  # after which git is taken for absent


@functools.cache
def fmtorch_version() -> str:
    """The version of the code that runs; in a checkout with its commit, and what sources were changed since.
    ``0.1.0`` installed; ``0.1.0+g5c0279c1d2e3`` in a checkout; ``0.1.0+g5c0279c1d2e3.dirty.0f1e2d3c4b5a``, with the
    digest of the sources, where they are not those of the commit; ``0.1.0+sources.0f1e2d3c4b5a`` without git."""
    checkout = PACKAGE.parent
    if not (checkout / "pyproject.toml").is_file():
        return __version__
    sources = _digest_of(sorted(PACKAGE.rglob("*.py")))[:DIGITS]
    commit = _git(checkout, "rev-parse", "HEAD") if (checkout / ".git").exists() else None
    changes = _git(checkout, "status", "--porcelain", "--untracked-files=all", "--", PACKAGE.name) if commit else None
    if not commit or changes is None:
        return f"{__version__}+sources.{sources}"
    return f"{__version__}+g{commit[:DIGITS]}" + (f".dirty.{sources}" if changes else "")


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints; None where it is not installed, refuses, or knows no commit."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=GIT_SECONDS, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


@functools.cache
def code_digest(module: str) -> str:
    """The digest of an imported module's source and of what it imports from its own code, at any depth.
    Its own code is the package for a module of fmtorch; for anybody else's the folder that its imports start from, and
    the files beside and below it whether it imports them or not; of installed packages only these."""
    name = getattr(sys.modules[module], "__file__", None)
    if name is None:
        raise TypeError(f"the code of {module} is in no file, so its changes cannot be noticed")
    file = Path(name).absolute()
    start = file.parents[module.count(".") + (file.stem == "__init__")]
    own = module.partition(".")[0] == PACKAGE.name
    if start.name in INSTALLED and not own:
        return _digest_of(sorted(file.parent.rglob("*.py") if "." in module else [file]))
    beside = set() if own or "." not in module else set(file.parent.rglob("*.py"))
    return _digest_of(sorted(beside | _imported(file, start, own)))


def _imported(file: Path, start: Path, own: bool) -> set[Path]:
    """The file, and those below `start` that it imports, and these in turn; of code that does not compile no more.
    own: whether it is of fmtorch, whose imports are followed then, and not those of anybody else."""
    files = [file]
    for each in files:  # which grows while it is read
        named = (path for statement in _imports(each.read_bytes()) for path in _files_of(statement, each, start, own))
        files += [path for path in dict.fromkeys(named) if path not in files]
    return set(files)


_Import = tuple[int | None, str, list[str]]  # dots that begin it (None: no `from`), module after `from`, names


@functools.cache  # parts of a pipeline share most of what they import
def _imports(source: bytes) -> list[_Import]:
    try:
        nodes = _statements(ast.parse(source))
    except (SyntaxError, ValueError):
        return []
    return [
        (getattr(node, "level", None), getattr(node, "module", None) or "", [alias.name for alias in node.names])
        for node in nodes
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]


def _statements(tree: ast.Module) -> list[ast.AST]:
    """All statements of a file, wherever in it; much faster than a walk through its expressions, too."""
    statements: list[ast.AST] = [tree]
    for node in statements:  # which grows while it is read
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            statements += getattr(node, block, ())
    return statements


def _files_of(statement: _Import, file: Path, start: Path, own: bool) -> Iterator[Path]:
    """The files below `start` that an import statement of `file` names.
    Of anybody's own code with the packages on the way; of fmtorch's, whose packages import all in them, without."""
    level, module, imported = statement
    if level is None:
        names = [(start, name) for name in imported]
    else:
        folder = file.parents[level - 1] if level else start
        names = [(folder, f"{module}.{name}".strip(".")) for name in imported]
        names += [(folder, module)] if module and own else []
    for folder, name in names:
        if folder == start and (name.partition(".")[0] == PACKAGE.name) != own:
            continue  # its version tells
        path = folder
        words = name.split(".")
        for depth, word in enumerate(words, start=1):
            path = path / word
            if not own or depth == len(words):
                yield from (p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file())


def _digest_of(files: list[Path]) -> str:
    return digest(b"".join(digest(path.read_bytes()).encode() for path in files))


def digest(data: Any) -> str:
    """The hex digest (blake2b, 128 bits) of bytes, or of an array's."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


LIBRARIES = ("numpy", "torch", "kornia", "onnxruntime")  # and OpenCV, which has several names as a package
VARIANTS = {"onnxruntime": ("onnxruntime-gpu", "onnxruntime-directml")}  # other packages of the same library


def configuration(part: object) -> Any:
    """A part of a pipeline as plain values that JSON can hold; equal values mean equal results.
    A dataclass is its class, its code and the code that it imports from its own package (`code_digest`), and its fields
    (not those with ``compare=False``); an object with an attribute `identity` is that attribute in place of the fields;
    a class is its name and code; a `Path` is the digest of the file; tensors and networks are the digests of their
    values. Raises TypeError for what does not say what defines it, OSError for a file that cannot be read."""
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
    if isinstance(part, torch.Tensor):
        values = part.detach().cpu().contiguous()
        return {"tensor": [str(part.dtype), list(part.shape), digest(values.reshape(-1).view(torch.uint8).numpy())]}
    kind, options = (part, {}) if isinstance(part, type) else (type(part), _options(part, code))
    digests = {"code": code_digest(kind.__module__)} if code else {}
    return {**options, "class": f"{kind.__module__}.{kind.__qualname__}", **digests}


def learned(part: object) -> list[str]:
    """Digests of the learned files and networks that a part of a pipeline uses, sorted; of a network's weights one.
    None for a part that does not say what defines it, or whose file cannot be read: it tells so itself when used."""
    try:
        return sorted(set(_learned(_plain(part, code=False))))
    except (TypeError, OSError):
        return []


def _learned(value: Any) -> Iterator[str]:
    for key, entry in value.items() if isinstance(value, dict) else enumerate(value if isinstance(value, list) else ()):
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
    remedy = "make it a dataclass, or give it an attribute `identity` of plain values"
    name = f"{type(part).__module__}.{type(part).__qualname__}"
    raise TypeError(f"{name} does not say what defines its results; {remedy}")


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
