"""Files of data sets, read so that whatever is wrong names file and line, or file and array."""

import pickle
import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Matrix = NDArray[np.float64]
Singles = NDArray[np.float32]
Indices = NDArray[np.int64]
Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]


class DataError(ValueError):
    """A data set that cannot be used as a whole; the message names file, line and what would be right."""


def given_root(root: str | Path | None, name: str, what: str) -> Path:
    """Where a data set lies. Raises DataError, with its name and what is wanted, where nobody says."""
    if root is None:
        raise DataError(f"{name} needs root: {what}")
    return Path(root).expanduser()


def images_by_stem(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The image files of a folder by their stems; of two with one stem that of the first suffix by name."""
    return {file.stem: file for file in sorted(folder.iterdir(), reverse=True) if file.suffix in suffixes}


def add_to_digest(digest: Any, name: str, path: Path) -> None:
    """Add a file, by a name that holds no place of its own: its size and bytes."""
    content = path.read_bytes() if path.is_file() else b""
    digest.update(f"{name}:{len(content)}:".encode() + content)


def numbered_again(identity: str, seen: Counter[str]) -> str:
    """The identity of a pair, with a number where it was seen before: a pair on a second line is a second pair."""
    seen[identity] += 1
    return identity if seen[identity] == 1 else f"{identity}#{seen[identity]}"


def read_lines(path: Path, hint: str = "") -> list[str]:
    """The lines of a text file without the empty ones at its end.
    hint: what is added where there is no such file. Raises DataError for a file that is missing or no text."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file{hint and f'; {hint}'}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as text ({error})") from error
    return text.rstrip().splitlines()


def numbered(path: Path, hint: str = "") -> Iterator[tuple[int, str]]:
    """The lines of a file that are neither empty nor comments (``#``), with their numbers from 1."""
    for number, line in enumerate(read_lines(path, hint), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line


def to_numbers(path: Path, number: int, words: list[str], columns: str, count: int) -> Matrix:
    """The numbers of one line. Raises DataError unless there are `count`; `columns` says what they mean."""
    if len(words) != count:
        raise DataError(f"{path}, line {number}: {len(words)} columns; it must have {count}: {columns}")
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError(f"{path}, line {number}: {error}; it must hold {count} numbers: {columns}") from error


def to_finite(path: Path, number: int, words: list[str], columns: str, count: int) -> Matrix:
    """The same where none may be NaN or infinite."""
    values = to_numbers(path, number, words, columns, count)
    if not np.isfinite(values).all():
        raise DataError(f"{path}, line {number}: a number that is not finite; it must hold {columns}")
    return values


def to_whole(path: Path, number: int, word: str, what: str) -> int:
    """A whole number of a line. Raises DataError for anything else."""
    try:
        return int(word)
    except ValueError:
        raise DataError(f"{path}, line {number}: {what} is {word!r}; it must be a whole number") from None


def read_numbers(path: Path, columns: str, count: int, hint: str = "") -> list[Matrix]:
    """A table of numbers without comments, one array a line."""
    lines = enumerate(read_lines(path, hint), start=1)
    return [to_numbers(path, number, line.split(), columns, count) for number, line in lines]


# Arrays of ``.npz`` files, also pickled objects, read without running what a pickle names

_CODE = re.compile(r"[biufUSO]\d*")  # dtypes: numbers, texts, objects
_CORE = re.compile(r"^numpy\._?core\.")  # before and from NumPy 2
_CONVERT = "load it with allow_pickle=True where you trust it, and write a text list (docs/guides/data.md)"


class NpzArrays:
    """The arrays of one ``.npz`` file by their names, read when asked for.
    Raises DataError, naming file and array, for what is no such file, an array that is missing or damaged, and one
    whose pickle holds anything but arrays, numbers, texts, lists, tuples and None."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as file:
                self.names = [name.removesuffix(".npy") for name in file.namelist()]
        except (OSError, zipfile.BadZipFile) as error:
            raise DataError(f"{path}: cannot be read as .npz ({error})") from error

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> Array:
        """An array of numbers or texts, or of dtype object, whose elements are None, plain values, lists or arrays."""
        if name not in self:
            raise DataError(f"{self.path}: no array {name!r}; it has {', '.join(self.names) or 'none'}")
        try:
            return self._read(name)
        except _ForeignError as error:
            problem = f"holds objects that are not read here ({error}); {_CONVERT}"
            raise DataError(f"{self.path}: {name!r} {problem}") from error
        except Exception as error:  # a damaged archive or pickle raises whatever its parts do
            problem = f"{type(error).__name__}: {error}".splitlines()[0]
            raise DataError(f"{self.path}: {name!r} cannot be read ({problem}); copy it again") from error

    def _read(self, name: str) -> Array:
        with zipfile.ZipFile(self.path) as file, file.open(f"{name}.npy") as stream:
            version = np.lib.format.read_magic(stream)
            header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, fortran, dtype = header[version](stream)
            if not dtype.hasobject:
                return np.frombuffer(stream.read(), dtype).reshape(shape, order="F" if fortran else "C")
            value = _plain(_Reader(stream, encoding="latin1").load())
            if not isinstance(value, np.ndarray) or value.dtype.kind != "O" or value.shape != shape:
                raise ValueError("the pickle holds another array than the header says")
            return value


class _DType:
    """A dtype as a pickle describes it: a code such as f8, and the order of its bytes."""

    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = code, "="

    def __setstate__(self, state: Any) -> None:
        self.order = state[1]

    def value(self) -> np.dtype[Any]:
        if not _CODE.fullmatch(self.code) or self.order not in ("<", ">", "=", "|"):
            raise ValueError(f"dtype {self.order}{self.code}")
        return np.dtype(object) if self.code[0] == "O" else np.dtype(f"{self.order}{self.code}")


class _Array:
    def __init__(self, *_: object) -> None:
        self.__setstate__((1, (0,), _DType("u1"), False, b""))

    def __setstate__(self, state: Any) -> None:
        _, self.shape, self.dtype, self.fortran, self.content = state

    @classmethod
    def of_buffer(cls, content: bytes | bytearray, dtype: _DType, shape: tuple[int, ...], order: str) -> "_Array":
        """As ``numpy._core.numeric._frombuffer``."""
        array = cls()
        array.__setstate__((1, shape, dtype, order == "F", bytes(content)))
        return array

    def value(self) -> Array:
        dtype = self.dtype.value()
        if dtype.kind == "O":
            flat = np.empty(len(self.content), object)
            for i, element in enumerate(self.content):
                flat[i] = _plain(element)
        else:
            flat = np.frombuffer(_bytes(self.content), dtype)
        return flat.reshape(self.shape, order="F" if self.fortran else "C")


class _ForeignError(pickle.UnpicklingError):
    """A name that a pickle uses and arrays do not need."""


class _Reader(pickle.Unpickler):
    """An unpickler for which six names stand for the above and below, and no other name for anything."""

    def find_class(self, module: str, name: str) -> Any:
        """What a name of the pickle stands for. Raises _ForeignError for any that arrays do not need."""
        known = _NAMES.get(f"{_CORE.sub('', module)}.{name}")
        if known is None:
            raise _ForeignError(f"{module}.{name}")
        return known


def _scalar(dtype: _DType, content: bytes | str) -> Any:
    return np.frombuffer(_bytes(content), dtype.value())[0].item()


def _encoded(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _ForeignError(f"_codecs.encode to {encoding}")
    return _bytes(text)


def _bytes(content: bytes | str) -> bytes:
    return content.encode("latin1") if isinstance(content, str) else content


_NAMES = {
    "multiarray._reconstruct": _Array, "multiarray.scalar": _scalar, "numeric._frombuffer": _Array.of_buffer,
    "numpy.ndarray": _Array, "numpy.dtype": _DType, "_codecs.encode": _encoded,
}  # fmt: skip


def _plain(value: Any) -> Any:
    """A value with arrays in place of their descriptions, at any depth."""
    if isinstance(value, _Array):
        return value.value()
    return type(value)(_plain(element) for element in value) if isinstance(value, list | tuple) else value
