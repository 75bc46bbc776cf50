"""The parts of a run's table: files that are whole or absent, merged as they grow in number."""

from __future__ import annotations

import hashlib
import time
import uuid
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from fmtorch.core.files import replacing

MERGED = 16  # parts of one level that become one of the next
MAX_LEVEL = 3  # 16^3 batches to a part at most: merging needs the memory of one


class PartWriter:
    """Adds parts to a folder, and merges those that it has added itself: any number of writers may do so at once.

    Names sort by the time at which the first rows of a part were written; they end with a digest of the bytes.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._own: list[list[Path]] = [[] for _ in range(MAX_LEVEL)]  # by level, in the order of time

    def add(self, table: pa.Table) -> None:
        """Write rows as a new part; where parts have become many, some of them as one."""
        self._kept(self._write(table, f"{time.time_ns():020d}"), 0)

    def _kept(self, path: Path, level: int) -> None:
        if level == MAX_LEVEL:
            return
        parts = self._own[level]
        parts.append(path)
        if len(parts) == MERGED:
            if (merged := self._merge(parts)) is not None:
                self._kept(merged, level + 1)
            parts.clear()

    def _merge(self, parts: Sequence[Path]) -> Path | None:
        """One part in place of several; killed in between, rows are there twice, which readers drop.

        None where one of them is damaged, for a reader to name, or the disk is full: they stay as they are.
        """
        try:
            merged = self._write(pa.concat_tables([read_part(path) for path in parts]), parts[0].name.split("-")[1])
        except (pa.ArrowException, OSError):
            return None
        for path in parts:
            path.unlink(missing_ok=True)
        return merged

    def _write(self, table: pa.Table, begun: str) -> Path:
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        data = sink.getvalue().to_pybytes()
        # The second word keeps simultaneous writers apart.
        path = self.folder / f"part-{begun}-{uuid.uuid4().hex[:8]}-{content_digest(data)}.parquet"
        with replacing(path) as temporary:
            temporary.write_bytes(data)
        return path


def part_files(folder: Path) -> list[Path]:
    """The parts in the order that their first rows were written."""
    return sorted(folder.glob("part-*.parquet"))


def part_bytes(path: Path) -> pa.BufferReader:
    """The bytes of a part. Raises ArrowInvalid where they are not those that were written."""
    data = path.read_bytes()
    if path.stem.split("-")[3:] != [content_digest(data)]:
        raise pa.ArrowInvalid("it is not what was written there")
    return pa.BufferReader(data)


def read_part(path: Path) -> pa.Table:
    """The rows of a part. Raises ArrowException or OSError where it cannot be read."""
    with pq.ParquetFile(part_bytes(path)) as parquet:
        return parquet.read()


def content_digest(data: bytes) -> str:
    """Hex digest (blake2b, 64 bits) of a part, which its name ends with."""
    return hashlib.blake2b(data, digest_size=8).hexdigest()
