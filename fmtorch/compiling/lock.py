"""A lock on a file of the cache: of several processes that lack a kernel one compiles it, the others wait for it."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class FileLock:
    """A lock that ends with its process, however that ends; without locks of files, as on Windows, it holds nothing."""

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(f"{path.name}.lock")
        self._descriptor: int | None = None

    def acquire(self) -> bool:
        """Wait for it; whether it is held."""
        try:
            import fcntl
        except ImportError:
            return False
        while self._descriptor is None:
            try:
                descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT)
            except OSError:  # a folder that can only be read
                return False
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                # The one that held it has removed it: another may hold a new one.
                if os.path.samestat(os.fstat(descriptor), os.stat(self.path)):
                    self._descriptor, descriptor = descriptor, -1
            except FileNotFoundError:
                continue
            except OSError:  # a file system without locks
                return False
            finally:
                if descriptor >= 0:
                    os.close(descriptor)
        return True

    def release(self) -> None:
        """Let the next one have it."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                self.path.unlink()
            os.close(self._descriptor)
            self._descriptor = None

    def __del__(self) -> None:  # of a kernel that did not compile
        self.release()
