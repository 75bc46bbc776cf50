"""Text files of data sets, read so that whatever is wrong names file and line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


class DataError(ValueError):
    """A data set that cannot be used as a whole; the message names file, line and what would be right."""


def given_root(root: str | Path | None, name: str, what: str) -> Path:
    """Where a data set lies. Raises DataError, with its name and what is wanted, where nobody says."""
    if root is None:
        raise DataError(f"{name} needs root: {what}")
    return Path(root).expanduser()


def read_lines(path: Path, hint: str = "") -> list[str]:
    """The lines of a text file without the empty ones at its end.

    hint: what is added where there is no such file. Raises DataError for a file that is missing or no text.
    """
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


def to_numbers(path: Path, number: int, words: list[str], columns: str, count: int) -> NDArray[np.float64]:
    """The numbers of one line. Raises DataError unless there are `count`; `columns` says what they mean."""
    if len(words) != count:
        raise DataError(f"{path}, line {number}: {len(words)} columns; it must have {count}: {columns}")
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError(f"{path}, line {number}: {error}; it must hold {count} numbers: {columns}") from error


def to_finite(path: Path, number: int, words: list[str], columns: str, count: int) -> NDArray[np.float64]:
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


def read_numbers(path: Path, columns: str, count: int, hint: str = "") -> list[NDArray[np.float64]]:
    """A table of numbers without comments, one array a line."""
    lines = enumerate(read_lines(path, hint), start=1)
    return [to_numbers(path, number, line.split(), columns, count) for number, line in lines]
