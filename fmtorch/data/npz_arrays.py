"""Arrays of ``.npz`` files, also those that NumPy stored as pickled objects, read without running what a pickle names.

A pickle is a program that calls what it names. Here every name that it may use stands for a class of this module that
holds data, and any other name is refused: nothing of the file is ever called.
"""

from __future__ import annotations

import pickle
import re
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.text_files import DataError

_CODE = re.compile(r"[biufUSO]\d*")  # dtypes: numbers, texts, objects
_CORE = re.compile(r"^numpy\._?core\.")  # before and from NumPy 2
_CONVERT = "load it with allow_pickle=True where you trust it, and write a text list (docs/guides/data.md)"


class NpzArrays:
    """The arrays of one ``.npz`` file by their names, read when asked for.

    Raises DataError, naming file and array, for what is no such file, an array that is missing or damaged, and one
    whose pickle holds anything but arrays, numbers, texts, lists, tuples and None.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as file:
                self.names = [name.removesuffix(".npy") for name in file.namelist()]
        except (OSError, zipfile.BadZipFile) as error:
            raise DataError(f"{path}: cannot be read as .npz ({error})") from error

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> NDArray[Any]:
        """An array of numbers or texts, or of dtype object, whose elements are None, plain values, lists or arrays."""
        if name not in self:
            raise DataError(f"{self.path}: no array {name!r}; it has {', '.join(self.names) or 'none'}")
        try:
            return self._read(name)
        except _ForeignError as error:
            raise DataError(
                f"{self.path}: {name!r} holds objects that are not read here ({error}); {_CONVERT}"
            ) from error
        except Exception as error:  # a damaged archive or pickle raises whatever its parts do
            problem = f"{type(error).__name__}: {error}".splitlines()[0]
            raise DataError(f"{self.path}: {name!r} cannot be read ({problem}); copy it again") from error

    def get(self, name: str) -> NDArray[Any] | None:
        """The same; None where there is no such array."""
        if name not in self:
            return None
        return self[name]

    def _read(self, name: str) -> NDArray[Any]:
        with zipfile.ZipFile(self.path) as file, file.open(f"{name}.npy") as stream:
            version = np.lib.format.read_magic(stream)
            header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, fortran, dtype = header[version](stream)
            if dtype.hasobject:
                value = _plain(_Reader(stream, encoding="latin1").load())
                if not isinstance(value, np.ndarray) or value.dtype.kind != "O" or value.shape != shape:
                    raise ValueError("the pickle holds another array than the header says")
                return value
            flat = np.frombuffer(stream.read(), dtype)
            return flat.reshape(shape, order=_order(fortran))


class _Array:
    """An array as a pickle describes it."""

    shape: tuple[int, ...] = ()
    dtype: _DType | None = None
    fortran = False
    content: Any = b""

    def __setstate__(self, state: Any) -> None:
        _, self.shape, self.dtype, self.fortran, self.content = state

    def value(self) -> NDArray[Any]:
        """The array itself."""
        if self.dtype is None:
            raise ValueError("an array without a dtype")
        dtype, order = self.dtype.value(), _order(self.fortran)
        if dtype.kind != "O":
            content = self.content.encode("latin1") if isinstance(self.content, str) else self.content
            return np.frombuffer(content, dtype).reshape(self.shape, order=order)
        flat = np.empty(len(self.content), object)
        for i, element in enumerate(self.content):
            flat[i] = _plain(element)
        return flat.reshape(self.shape, order=order)


class _DType:
    """A dtype as a pickle describes it: a code such as f8, and the order of its bytes."""

    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = code, "="

    def __setstate__(self, state: Any) -> None:
        self.order = state[1]

    def value(self) -> np.dtype[Any]:
        """The dtype itself."""
        if not _CODE.fullmatch(self.code) or self.order not in ("<", ">", "=", "|"):
            raise ValueError(f"dtype {self.order}{self.code}")
        return np.dtype(object) if self.code[0] == "O" else np.dtype(f"{self.order}{self.code}")


class _ForeignError(pickle.UnpicklingError):
    """A name that a pickle uses and arrays do not need."""


class _Reader(pickle.Unpickler):
    """An unpickler for which the names of NumPy stand for the classes above, and no other name for anything."""

    def find_class(self, module: str, name: str) -> Any:
        """What a name of the pickle stands for. Raises _ForeignError for any that arrays do not need."""
        stands_for = {
            "multiarray._reconstruct": _empty, "multiarray.scalar": _scalar, "numeric._frombuffer": _from_buffer,
            "numpy.ndarray": _Array, "numpy.dtype": _DType, "_codecs.encode": _encoded,
        }  # fmt: skip
        known = stands_for.get(f"{_CORE.sub('', module)}.{name}")
        if known is None:
            raise _ForeignError(f"{module}.{name}")
        return known


def _order(fortran: bool) -> Literal["F", "C"]:
    return "F" if fortran else "C"


def _empty(*_: object) -> _Array:
    return _Array()


def _scalar(dtype: _DType, content: bytes | str) -> Any:
    raw = content.encode("latin1") if isinstance(content, str) else content
    return np.frombuffer(raw, dtype.value())[0].item()


def _from_buffer(content: bytes | bytearray, dtype: _DType, shape: tuple[int, ...], order: str) -> _Array:
    array = _Array()
    array.shape, array.dtype, array.fortran, array.content = shape, dtype, order == "F", bytes(content)
    return array


def _encoded(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _ForeignError(f"_codecs.encode to {encoding}")
    return text.encode("latin1")


def _plain(value: Any) -> Any:
    """A value with arrays in place of their descriptions, at any depth."""
    if isinstance(value, _Array):
        return value.value()
    if isinstance(value, list | tuple):
        return type(value)(_plain(element) for element in value)
    return value
