"""Matches on disk: Arrow files with a row for each pair, read through a memory map, whole or recognised as damaged."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fmtorch.core.files import replacing

FORMAT = 1  # of the files; raised when the schema changes

_PER_MATCH = {
    **dict.fromkeys(("x0", "x1"), ("float32", (-1, 2))), "label": ("int8", (-1,)),
    **dict.fromkeys(("quality", "prior", "noise"), ("float32", (-1,))), "mutual": ("uint8", (-1,)),
    **dict.fromkeys(("lafs0", "lafs1"), ("float32", (-1, 2, 3))),
}  # fmt: skip
_PER_PAIR = {
    **dict.fromkeys(("F", "K0", "K1"), ("float64", (3, 3))), **dict.fromkeys(("size0", "size1"), ("int64", (2,))),
}  # fmt: skip
_SHAPES = {name: shape for name, (_, shape) in (_PER_PAIR | _PER_MATCH).items()}
_TEXTS = ("identity", "family", "scene", "reason")
SCHEMA = pa.schema(
    [
        pa.field("key", pa.int64()),
        *(pa.field(name, pa.string()) for name in _TEXTS),
        pa.field("matches", pa.int64()),
        pa.field("inliers", pa.int64()),
        pa.field("outliers", pa.int64()),
        *(pa.field(name, pa.list_(pa.from_numpy_dtype(kind))) for name, (kind, _) in _PER_PAIR.items()),
        *(pa.field(name, pa.list_(pa.from_numpy_dtype(kind))) for name, (kind, _) in _PER_MATCH.items()),
    ]
)
INDEX = ("key", *_TEXTS, "matches", "inliers", "outliers")  # what is known of a pair without its matches

Row = Mapping[str, Any]


class ShardError(ValueError):
    """A file of matches that is missing, damaged or of another version; the message names it."""


def write_shard(path: Path, rows: Sequence[Row]) -> None:
    """Write rows of `SCHEMA`: texts, integers, flat arrays, None for what a pair does not have. Whole or absent."""
    columns = [pa.array([row.get(field.name) for row in rows], field.type) for field in SCHEMA]
    batch = pa.record_batch(columns, schema=SCHEMA)
    about = {"format": str(FORMAT), "checksum": str(_checksum(batch))}
    batch = batch.replace_schema_metadata(about)
    with (
        replacing(path) as temporary,
        pa.OSFile(str(temporary), "wb") as sink,
        pa.ipc.new_file(sink, batch.schema) as writer,
    ):
        writer.write_batch(batch)


class Shard:
    """A file of matches, mapped into memory: reading a pair touches the bytes of that pair only.

    verify: check every byte against the checksum, at about 1 GB/s.
    Raises ShardError for a file that is missing, damaged or of another version.
    """

    def __init__(self, path: Path, *, verify: bool = False) -> None:
        self.path = path
        try:
            self._file = pa.memory_map(str(path))
            reader = pa.ipc.open_file(self._file)
            about = reader.schema.metadata or {}
            if about.get(b"format") != str(FORMAT).encode() or not reader.schema.equals(SCHEMA):
                raise ShardError(f"{path} is not of format {FORMAT} of this version")
            self.batch = reader.get_batch(0)
            if verify:
                self.batch.validate(full=True)
                if about.get(b"checksum") != str(_checksum(self.batch)).encode():
                    raise ShardError(f"{path} is damaged: its checksum is wrong")
        except (pa.ArrowException, OSError, ValueError) as error:
            raise error if isinstance(error, ShardError) else ShardError(f"{path} cannot be read: {error}") from error

    def __len__(self) -> int:
        """Number of pairs."""
        return int(self.batch.num_rows)

    def index(self) -> dict[str, list[Any]]:
        """What is known of each pair without its matches: the columns of `INDEX`."""
        return {name: self.batch.column(name).to_pylist() for name in INDEX}

    def read(self, row: int, names: Sequence[str] = (*_PER_PAIR, *_PER_MATCH)) -> dict[str, NDArray[Any]]:
        """A pair's arrays, views of the file: points (n, 2), frames (n, 2, 3), F (3, 3), ...; absent ones left out."""
        columns = ((name, self._list(name, row)) for name in names)
        return {name: values.reshape(_SHAPES[name]) for name, values in columns if values is not None}

    def _list(self, name: str, row: int) -> NDArray[Any] | None:
        column = self.batch.column(name)
        if not column[row].is_valid:
            return None
        start, end = (column.offsets[i].as_py() for i in (row, row + 1))
        values: NDArray[Any] = column.values.slice(start, end - start).to_numpy(zero_copy_only=True)
        return values


def _checksum(batch: pa.RecordBatch) -> int:
    """CRC-32 over the values of all columns."""
    total = 0
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        total = zlib.crc32(name.encode(), total)
        if pa.types.is_list(column.type):
            total = zlib.crc32(np.asarray(column.is_valid()).tobytes(), total)
            total = zlib.crc32(column.offsets.to_numpy().tobytes(), total)
            values = column.values.to_numpy(zero_copy_only=True)
            total = zlib.crc32(values.data if len(values) else b"", total)
        else:
            total = zlib.crc32(repr(column.to_pylist()).encode(), total)
    return total
