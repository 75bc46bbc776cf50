"""The folder of compiled kernels: one file each, in a folder for this version of numba and this processor.

numba's own cache does not notice when a function that a kernel calls is edited in another module, and cannot be read
where it cannot be written. Here the names of folder and file hold digests of all that decides the machine code, so that
a file is never stale, and it is written in one step, so that several processes may share it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import pickle
import platform
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fmtorch.compiling import calls
from fmtorch.core.resources import cache_dir

HERE = Path(__file__).resolve().parent
_HOW = (  # the files that say how
    "kernel.py", "fused.py", "inner.py", "calls.py", "version.py", "lanes.py", "lane_types.py", "lane_functions.py",
)  # fmt: skip
ABOUT = "about.json"  # in each folder; its time of change is when the folder was last used
UNUSED_DAYS = 30  # after which a folder is removed
_SETTINGS = ("BOUNDSCHECK", "CPU_FEATURES", "CPU_NAME", "DEBUGINFO_DEFAULT", "ENABLE_AVX", "LOOP_VECTORIZE", "OPT")
_SIGNATURE_BYTES = 16


def kernels_dir() -> Path:
    """Where the folders of all versions are."""
    return cache_dir() / "kernels"


def versions() -> dict[str, str]:
    """What decides the machine code besides the kernel: how it is compiled, numba, llvmlite, Python, the processor."""
    import llvmlite
    import numba
    from llvmlite import binding

    settings = {name: str(getattr(numba.config, name, None)) for name in _SETTINGS}
    features = binding.get_host_cpu_features().flatten()
    return {
        "compiling": _hex(b"".join((HERE / name).read_bytes() for name in _HOW)), "numba": numba.__version__,
        "llvmlite": llvmlite.__version__, "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}", "processor": binding.get_host_cpu_name(),
        "features": features, "settings": json.dumps(settings),
    }  # fmt: skip


@functools.cache
def folder() -> Path | None:
    """The folder for this version, marked as used now; None, with a warning, where there is none and none can be made.

    Folders that were not used for `UNUSED_DAYS` are removed.
    """
    about = versions()
    path = kernels_dir() / _hex(json.dumps(about).encode())[:16]
    try:
        path.mkdir(parents=True, exist_ok=True)
        (path / ABOUT).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        if path.is_dir():
            return path  # what is there can be read
        warnings.warn(f"compiled kernels are not kept: {error}", stacklevel=2)
        return None
    _remove_unused(path)
    return path


def _remove_unused(used: Path) -> None:
    oldest = time.time() - UNUSED_DAYS * 24 * 3600
    for file in used.glob("*.bin"):
        with contextlib.suppress(OSError):  # somebody else removed it
            if file.stat().st_mtime < oldest:
                file.unlink()
    for other in used.parent.iterdir():
        try:
            if other != used and (other / ABOUT).stat().st_mtime < oldest:
                shutil.rmtree(other, ignore_errors=True)
        except OSError:
            continue  # not one of ours, or somebody else removed it


def path(function: Callable[..., Any], version: str) -> Path | None:
    """The file of a version of a kernel, which need not exist; None where there is no folder."""
    where = folder()
    return None if where is None else where / f"{function.__module__}.{function.__qualname__}-{version[:16]}.bin"


class KernelFile:
    """The file of one version of a kernel; what numba calls the cache of a function.

    missing: called before the function is compiled, with words that say where it will be kept. calls: once loaded or
    saved, the kernels that the function calls.
    """

    def __init__(self, path: Path | None, missing: Callable[[str], None]) -> None:
        self.path, self.missing = path, missing
        self.calls: list[Any] = []
        self._lock: Any = None  # held while this process compiles; it ends with the process, however that ends

    @property
    def cache_path(self) -> str | None:
        """The folder, for numba's statistics."""
        return None if self.path is None else str(self.path.parent)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The compiled function of the file; None where there is none, with a warning if it is damaged."""
        target_context.refresh()
        if (loaded := self._loaded(signature, target_context)) is not None:
            return loaded
        if self._acquire() and (loaded := self._loaded(signature, target_context)) is not None:
            self._release()
            return loaded  # another process has just compiled it
        kept = "for this process" if self.path is None else f"for this machine, once (kept in {self.path.parent})"
        self.missing(kept)
        return None

    def _loaded(self, signature: Any, target_context: Any) -> Any:
        from numba.core.compiler import CompileResult

        try:
            if self.path is not None:
                written = self.path.read_bytes()
                data = written[_SIGNATURE_BYTES:]
                if written[:_SIGNATURE_BYTES] == _signature(data):
                    with contextlib.suppress(OSError):  # a folder that can be read, but not written
                        os.utime(self.path)  # so that files in use are not the oldest
                    self.calls = calls.called(data)
                    return _of(signature, CompileResult._rebuild(target_context, *pickle.loads(data)))
                warnings.warn(f"{self.path} is damaged; it is compiled anew", stacklevel=2)
                with contextlib.suppress(OSError):
                    self.path.unlink(missing_ok=True)
        except FileNotFoundError:
            pass
        except OSError as error:
            warnings.warn(f"{self.path} cannot be read ({error}); it is compiled anew", stacklevel=2)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Write a compiled function; where that fails, it is not kept, with a warning."""
        from numba.core.serialize import dumps

        try:
            data = dumps(result._reduce())
            self.calls = calls.called(data)
            if self.path is not None and not result._asdict()["library"].has_dynamic_globals:
                _write(self.path, _signature(data) + data)
        finally:
            self._release()

    def _acquire(self) -> bool:
        """Wait for a process that compiles the same; False where no file can be locked."""
        import filelock  # only now: loading a kernel needs none

        if self.path is None or self._lock is not None:  # held since a compilation that failed
            return self._lock is not None
        lock = filelock.FileLock(self.path.with_name(f"{self.path.name}.lock"), thread_local=False)
        try:
            lock.acquire()
        except (OSError, NotImplementedError):  # a folder that can only be read, a file system without locks
            return False
        self._lock = lock
        return True

    def _release(self) -> None:
        """Let other processes that wait for the file have it."""
        if self._lock is not None:
            self._lock.release()
            with contextlib.suppress(OSError):
                Path(self._lock.lock_file).unlink()
            self._lock = None

    def flush(self) -> None:
        """Remove the file."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def _write(path: Path, data: bytes) -> None:
    from fmtorch.core.files import replacing

    try:
        with replacing(path) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        warnings.warn(f"compiled kernels are not kept: {error}", stacklevel=3)


def _of(signature: Any, result: Any) -> Any:
    """A compiled function by the types of this process: a group of a script or a notebook is another class in each."""
    from numba.core import sigutils
    from numba.core.typing import signature as typed

    arguments, _ = sigutils.normalize_signature(signature)
    return result._replace(signature=typed(result.signature.return_type, *arguments))


def _signature(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_SIGNATURE_BYTES).digest()


def _hex(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
