"""HDF5 files of others, read with errors that name file and key."""

import contextlib
import functools
import hashlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.core import lazy
from fmtorch.data.files import Array, DataError, Matrix

HASHED_WHOLE = 1 << 30  # bytes up to which a file is hashed as a whole
_BLOCKS, _BLOCK = 4096, 1 << 16  # of larger files: how many blocks of how many bytes
SUFFIXES = (".h5", ".hdf5")


def imported() -> Any:
    """h5py. Raises ImportError naming the extra where it is not installed."""
    return lazy.imported("h5py", "h5py is not installed; pip install 'fmtorch[h5]' brings it")


_library = functools.cache(imported)  # where a file is open


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """An HDF5 file for reading. Raises DataError where it is missing, no such file, or damaged."""
    h5py = imported()
    try:
        file = h5py.File(path, "r")
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except OSError as error:
        raise DataError(f"{path}: is not a valid HDF5 file ({_first_line(error)})") from error
    with file:
        yield file


def keys(file: Any, deep: bool = False) -> list[str]:
    """The names directly below a file or group, or at any depth. Raises DataError where they cannot be read."""
    names: list[str] = []
    try:
        if deep:
            file.visit(names.append)
        return names if deep else [str(name) for name in file]
    except (OSError, RuntimeError) as error:
        raise DataError(f"{where(file)}: its keys cannot be read ({_first_line(error)})") from error


def groups_with(file: Any, *names: str) -> list[str]:
    """The paths of the groups that hold an array of one of these names, at any depth."""
    ends = (path.rpartition("/") for path in keys(file, deep=True))
    return [group for group, _, name in ends if name in names and group]


def holds(file: Any, key: str) -> bool:
    """Whether a file or group has the key, at any depth."""
    try:
        return key.encode() in file.id
    except (OSError, RuntimeError) as error:
        raise DataError(f"{where(file, key)} cannot be read ({_first_line(error)})") from error


def array(file: Any, key: str, *shape: int | None, floats: bool = False) -> Array:
    """The array under a key, of this shape; None stands for any length, no shape for any. floats: as float64 where it
    holds numbers. Raises DataError, naming file and key, where it is missing, damaged or of another shape."""
    try:
        values = _plain_array(file, key, floats)
        if values is None:
            entry = file[key]
            if not hasattr(entry, "shape"):
                raise DataError(f"{where(file, key)} is a group; it must be an array")
            values = np.asarray(entry[()])
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        if not holds(file, key):
            raise DataError(f"{where(file, key)} is missing") from None
        raise DataError(f"{where(file, key)} cannot be read ({_first_line(error)})") from error
    if shape and not fits(values, shape):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise DataError(f"{where(file, key)} has shape {values.shape}; it must be ({wanted})")
    return values


def fits(values: Array, shape: Sequence[int | None]) -> bool:
    """Whether an array has a shape, in which None stands for any length."""
    return values.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, values.shape, strict=True))


def _plain_array(file: Any, key: str, floats: bool) -> Array | None:
    """The numbers under a key by HDF5's own calls, in a third of h5py's time; None where it is anything else."""
    h5py = _library()
    try:
        entry = h5py.h5d.open(file.id, key.encode())
        dtype, shape = np.dtype(np.float64) if floats else entry.dtype, entry.shape
        if dtype.kind not in "fiub" or shape is None:
            return None
        values = np.empty(shape, dtype)
        entry.read(h5py.h5s.ALL, h5py.h5s.ALL, values, _memory_type(dtype))
    except (OSError, RuntimeError, KeyError, TypeError, ValueError):
        return None
    return values


@functools.cache
def _memory_type(dtype: Any) -> Any:
    """HDF5's type of a NumPy type, which takes as long to make as a small array to read."""
    return imported().h5t.py_create(dtype)


def shape(file: Any, key: str) -> tuple[int, ...]:
    """Of the array under a key, which is not read. Raises DataError where there is none."""
    try:
        return tuple(imported().h5d.open(file.id, key.encode()).shape)
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where(file, key)} cannot be read ({_first_line(error)})") from error


def numbers(file: Any, key: str, *shape: int | None) -> Matrix:
    """`array` as float64. Raises DataError where it holds no real numbers."""
    values = array(file, key, *shape, floats=True)
    if values.dtype.kind not in "fiub":
        raise DataError(f"{where(file, key)} is of {values.dtype}; it must hold real numbers")
    return values.astype(np.float64, copy=False)


def reshaped(file: Any, key: str, *shape: int) -> Matrix:
    """`numbers` of any shape that hold as many as this one, finite. Raises DataError where they do not."""
    values = numbers(file, key)
    if values.size != math.prod(shape):
        raise DataError(f"{where(file, key)} has shape {values.shape}; it must hold {math.prod(shape)} numbers")
    if not np.isfinite(values).all():
        raise DataError(f"{where(file, key)} has an entry that is not finite")
    return values.reshape(shape)


def text(file: Any, key: str) -> str:
    """The string under a key, be it alone or the only one of an array."""
    value: Any = array(file, key).reshape(-1)
    value = value[0] if len(value) else ""
    return value.decode() if isinstance(value, bytes) else str(value)


def add_to_digest(digest: Any, path: Path) -> None:
    """Add a file's name, size and bytes; of a file beyond a gigabyte, blocks that are spread over it."""
    size = path.stat().st_size
    digest.update(f"{path.name}:{size}:".encode())
    with path.open("rb") as file:
        if size <= HASHED_WHOLE:
            digest.update(hashlib.file_digest(file, "blake2b").digest())
            return
        for start in np.linspace(0, size - _BLOCK, _BLOCKS).astype(np.int64):
            file.seek(int(start))
            digest.update(file.read(_BLOCK))


def files(root: Path) -> list[Path]:
    """The HDF5 file that root is, or those directly below it. Raises DataError where there are none."""
    if root.is_file():
        return [root]
    paths = sorted(path for suffix in SUFFIXES for path in root.glob(f"*{suffix}"))
    if not paths:
        raise DataError(f"{root}: {'holds no' if root.is_dir() else 'no such'} file {' or '.join(SUFFIXES)}")
    return paths


def where(file: Any, key: str | None = None) -> str:
    """What messages call a key of a file or group: the file's name, and the whole path of the key."""
    group = str(getattr(file, "name", "") or "").strip("/")
    path = "/".join(part for part in (group, key or "") if part)
    return f"{file.file.filename}: {path!r}" if path else str(file.file.filename)


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
