"""Arrays kept on disk by name, one NumPy file each, in a folder of bounded size that several processes may share."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.files import replacing

Arrays = dict[str, NDArray[Any]]
DIGEST = "digest"  # the array that holds the digest of the others
SLACK = 0.05  # share of the bound that is freed at once, so that the folder is not listed for every file
ABANDONED = 3600.0  # seconds after which a temporary file is a dead writer's


class ArrayCache:
    """Files ``<folder>/<section>/<name>.npz``, each whole or absent. Safe with several threads and processes.

    limit: bytes; when more are kept, the least recently used files go (each process may exceed it by `SLACK`). None: no
    bound. A file that is damaged, or holds other arrays than were written under its name, counts as absent, with a
    warning; what cannot be written is not kept, with a warning.
    Raises ValueError where the folder is a file or the limit is not positive.
    """

    def __init__(self, folder: Path, limit: int | None = None) -> None:
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"cache={folder} is a file; it must name a folder, or be off")
        if limit is not None and limit <= 0:
            raise ValueError(f"the cache's limit is {limit} bytes; it must be positive, or null for none")
        self.folder, self.limit = folder, limit
        self._lock = threading.Lock()
        self._unseen: float = np.inf  # bytes written since the folder was last listed

    def describe(self, section: str, about: Mapping[str, Any]) -> None:
        """Say, for a human reader, what a section's files are."""
        file = self.folder / section / "about.json"
        if not file.exists():
            with self._excused(file):
                file.parent.mkdir(parents=True, exist_ok=True)
                with replacing(file) as temporary:
                    temporary.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")

    def read(self, section: str, name: str) -> Arrays | None:
        """The arrays of that name, or None. Executes nothing that is in the file (no pickle), checks its checksums."""
        path = self._path(section, name)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
            if arrays.pop(DIGEST).tobytes() != self._digest(section, name, arrays):
                raise ValueError("it is not what was written there")
            os.utime(path)  # used now
        except FileNotFoundError:
            return None
        except Exception as error:  # a damaged file may make the reader raise nearly anything
            warnings.warn(f"{path} is damaged ({error}); it is computed anew", stacklevel=2)
            return None
        return arrays

    def write(self, section: str, name: str, arrays: Arrays) -> None:
        """Keep arrays of numbers under that name, in place of what is there."""
        path = self._path(section, name)
        with self._excused(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary, temporary.open("wb") as file:
                digest = np.frombuffer(self._digest(section, name, arrays), np.uint8)
                np.savez(file, **arrays, **{DIGEST: digest})  # type: ignore[arg-type]
            self._grown(sum(array.nbytes for array in arrays.values()))

    def files(self) -> Iterator[tuple[Path, os.stat_result]]:
        """The files that are kept."""
        yield from _listed(self.folder.glob("*/*.npz"))

    def trim(self) -> None:
        """Remove the least recently used files beyond the limit, and what dead writers left."""
        for path, status in _listed(self.folder.glob("*/*.tmp")):
            if time.time() - status.st_mtime > ABANDONED:
                path.unlink(missing_ok=True)
        if self.limit is None:
            return
        kept = sorted(self.files(), key=lambda entry: entry[1].st_mtime_ns)
        excess = sum(status.st_size for _, status in kept) - self.limit
        if excess > 0:
            excess += int(SLACK * self.limit)
        for path, status in kept:
            if excess <= 0:
                break
            path.unlink(missing_ok=True)
            excess -= status.st_size

    @staticmethod
    def _digest(section: str, name: str, arrays: Arrays) -> bytes:
        """Of the file's place and all that it holds."""
        digest = hashlib.blake2b(f"{section}/{name}".encode(), digest_size=16)
        for key, array in sorted(arrays.items()):
            digest.update(repr((key, array.dtype.str, array.shape)).encode())
            digest.update(np.ascontiguousarray(array).data)
        return digest.digest()

    def _path(self, section: str, name: str) -> Path:
        return self.folder / section / f"{name}.npz"

    def _grown(self, size: int) -> None:
        with self._lock:
            self._unseen += size
            if self._unseen >= SLACK * (self.limit or np.inf):
                self.trim()
                self._unseen = 0

    @contextlib.contextmanager
    def _excused(self, path: Path) -> Iterator[None]:
        """A full disk or a folder that may not be written costs the cache, not the run."""
        try:
            yield
        except OSError as error:
            warnings.warn(f"nothing is kept in {path.parent}: {error.strerror or error}", stacklevel=3)


def _listed(paths: Iterator[Path]) -> Iterator[tuple[Path, os.stat_result]]:
    """Those that are still there, with what is known of them."""
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            yield path, path.stat()
