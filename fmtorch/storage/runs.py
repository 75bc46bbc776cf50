"""The run folder: one evaluation's identity, its pairs' results as they come, its summary.

::

    run.json               the identity; written first, never changed
    pairs/part-*.parquet   rows of `PAIR_SCHEMA`; any number of processes may add parts (`fmtorch.storage.parts`)
    summary.json, summary.md
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fmtorch.core.files import replacing
from fmtorch.core.settings import canonical, create, differences, head
from fmtorch.storage.parts import PartWriter, part_bytes, part_files
from fmtorch.storage.rows import PAIR_SCHEMA, PairRow, to_table

FORMAT = 1  # of the folder; to be raised when the schema changes, or what the identity tells
_LISTINGS = 20  # at most, until parts are those that were listed


class RunFolderError(ValueError):
    """A run folder that cannot be used as asked; the message says what to do."""


def identity_digest(config: Mapping[str, Any]) -> str:
    """The hex digest (blake2b, 128 bits) of what defines a run's results.

    config: plain dicts, lists, strings, numbers, booleans and None: the pipeline's configuration, the data set's name
    and digest, the seed, the digests of learned files, the version. Raises TypeError for anything else.
    """
    return hashlib.blake2b(canonical(config).encode(), digest_size=16).hexdigest()


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """An evaluation on disk; made by `open` (to write) or `load` (to read)."""

    path: Path
    config: dict[str, Any]  # what defines the results, see `identity_digest`

    @classmethod
    def open(cls, path: Path | str, config: Mapping[str, Any]) -> RunFolder:
        """Start a run in `path`, or continue it there when the folder holds a run of the same identity.

        Several processes may open the same folder at once. Raises RunFolderError, touching nothing, where the folder
        holds a run of another identity or files that are no run.
        """
        path = Path(path)
        wanted: dict[str, Any] = json.loads(canonical(config))
        if path.exists() and not path.is_dir():
            raise RunFolderError(f"{path} is a file; run_dir must name a folder")
        path.mkdir(parents=True, exist_ok=True)
        foreign = sorted(entry.name for entry in path.iterdir() if entry.suffix != ".tmp")
        if not (path / "run.json").exists():
            if foreign:
                raise RunFolderError(
                    f"{path} is not empty and has no run.json, so it is no run folder (it holds {head(foreign)}); "
                    "choose another run_dir"
                )
            stored = {"format": FORMAT, "identity": identity_digest(wanted), "config": wanted}
            create(path / "run.json", json.dumps(stored, indent=2) + "\n")
        folder = cls.load(path)
        if folder.identity != identity_digest(wanted):
            raise RunFolderError(
                f"{path} holds another run; what differs (there -> now): {differences(folder.config, wanted)}. "
                "Choose another run_dir, or delete the folder"
            )
        (path / "pairs").mkdir(exist_ok=True)
        return folder

    @classmethod
    def load(cls, path: Path | str) -> RunFolder:
        """The existing run in `path`, whatever its identity. Raises RunFolderError where there is none."""
        file = Path(path) / "run.json"
        try:
            stored = json.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise RunFolderError(f"{path} is no run folder: it has no run.json") from None
        except ValueError as error:
            raise RunFolderError(f"{file} is not valid JSON ({error}); delete the folder and run again") from error
        if not isinstance(stored, dict) or not isinstance(stored.get("config"), dict):
            raise RunFolderError(f"{file} was not written by this program: it has no 'config'")
        if stored.get("format") != FORMAT:
            raise RunFolderError(
                f"{file} has format {stored.get('format')}, this version reads {FORMAT}; choose another run_dir"
            )
        if stored.get("identity") != identity_digest(stored["config"]):
            raise RunFolderError(
                f"{file} was changed: its identity is not that of its config; put it back as it was, or delete the "
                "folder and run again"
            )
        return cls(Path(path), stored["config"])

    @property
    def identity(self) -> str:
        """The digest of what defines the results."""
        return identity_digest(self.config)

    def append(self, rows: Sequence[PairRow]) -> None:
        """Add results, as a new part that is either whole or absent; parts are merged. Safe with several processes."""
        if not rows:
            return
        self._writer.add(to_table(rows))

    def done(self) -> set[int]:
        """The keys of the pairs that have a result."""
        return {int(key) for part in self._parts(["key"]) for key in part["key"].to_numpy()}

    def read(self, keys: Collection[int] | None = None, without: Collection[str] = ()) -> pa.Table:
        """The results, a row of `PAIR_SCHEMA` per pair, without some columns: all, or those of the given keys.

        Of several rows of one pair the first written counts. Raises RunFolderError naming a part that cannot be read.
        """
        names = [name for name in PAIR_SCHEMA.names if name not in without]
        table = pa.concat_tables([PAIR_SCHEMA.empty_table().select(names), *self._parts(names)])
        stored_keys = table["key"].to_numpy()
        _, first = np.unique(stored_keys, return_index=True)
        if keys is not None:
            first = first[np.isin(stored_keys[first], np.fromiter(keys, np.int64, len(keys)))]
        return table.take(np.sort(first))

    def write_summary(self, summary: Mapping[str, Any], markdown: str) -> None:
        """Write ``summary.json`` and ``summary.md``. Raises ValueError for NaN, which JSON does not have."""
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        for name, content in (("summary.json", text), ("summary.md", markdown)):
            with replacing(self.path / name) as temporary:
                temporary.write_text(content, encoding="utf-8")

    @functools.cached_property
    def _writer(self) -> PartWriter:
        return PartWriter(self.path / "pairs")

    def _parts(self, columns: list[str]) -> list[pa.Table]:
        """The parts in the order they were written; of a part's columns only those asked for."""
        parts: list[pa.Table] | None = None
        for _ in range(_LISTINGS):  # another process may merge parts while they are read
            files = part_files(self.path / "pairs")
            try:
                parts = [self._part(file, columns) for file in files]
            except FileNotFoundError:
                continue
            if part_files(self.path / "pairs") == files:
                return parts
        if parts is None:
            raise RunFolderError(f"{self.path}: its parts cannot be read while others merge them; try again")
        return parts

    def _part(self, file: Path, columns: list[str]) -> pa.Table:
        try:
            with pq.ParquetFile(part_bytes(file)) as parquet:
                if not parquet.schema_arrow.equals(PAIR_SCHEMA):
                    raise pa.ArrowInvalid("its columns are not those of this version")
                return parquet.read(columns=columns)
        except FileNotFoundError:
            raise
        except (pa.ArrowException, OSError) as error:
            raise RunFolderError(
                f"{file} cannot be read ({error}); delete it and start the run again, which computes its pairs anew"
            ) from error
