"""The folder of compiled kernels: one file each, in a folder for this version of numba and this processor.

numba's own cache does not notice when a function that a kernel calls is edited in another module, and cannot be read
where it cannot be written. Here the names of folder and file hold digests of all that decides the machine code, so that
a file is never stale, and it is written in one step, so that several processes may share it.

A version is taken from live functions, not from files: bytecode, constants, defaults, and every value that the bytecode
takes from its module or its closure. An inner function among them is compiled into the one that calls it, so its own
bytecode and values count as well; of a kernel, which is called through its address, only name and signature do.
Comments, docstrings, line numbers, and what no kernel reaches count for nothing."""

import contextlib
import dis
import enum
import functools
import hashlib
import json
import os
import pickle
import platform
import shutil
import sys
import time
import types
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.core.files import cache_dir, write_whole
from fmtorch.jit import linking

Function = Callable[..., Any]
FOREIGN = {*sys.stdlib_module_names, "builtins", "numpy"}  # packages whose functions and types count by name alone


def version(function: Function, *also: str) -> str:
    """The version of a function as hexadecimal digits. also: what decides its machine code besides.
    Raises TypeError where it takes a value of which no version can be told."""
    reached, parts = [function], []
    for each in reached:  # which grows while it is read
        own, inner = _own(each)
        reached += [other for other in inner if other not in reached]
        parts.append((own, [reached.index(other) for other in inner]))
    return hashlib.blake2b(repr((also, parts)).encode(), digest_size=16).hexdigest()


@functools.cache
def _own(function: Function) -> tuple[bytes, list[Function]]:
    """The digest of what one function is made of but for the inner functions that it uses; these."""
    untyped: Any = function
    code, cells, reached = untyped.__code__, untyped.__closure__ or (), list[Function]()

    def described(name: str, value: Any) -> Any:
        if isinstance(value, types.ModuleType) and value.__name__.partition(".")[0] not in FOREIGN:
            used = [each for each in _names(code) if each in vars(value)]
            return name, [described(f"{name}.{each}", vars(value)[each]) for each in used]
        try:
            return name, _value(value, reached)
        except TypeError as error:
            raise TypeError(f"{function.__module__}.{function.__qualname__} uses {name}: {error}") from None

    parts = [
        _code(code, untyped.__doc__),
        described("its defaults", (untyped.__defaults__, untyped.__kwdefaults__)),
        *[described(name, cell.cell_contents) for name, cell in zip(code.co_freevars, cells, strict=True)],
        *[described(name, untyped.__globals__[name]) for name in _global_names(code) if name in untyped.__globals__],
    ]
    return hashlib.blake2b(repr(parts).encode(), digest_size=16).digest(), reached


def _code(code: types.CodeType, docstring: str | None = None) -> tuple[Any, ...]:
    constants = [
        _code(each) if isinstance(each, types.CodeType) else _value(each, [])
        for place, each in enumerate(code.co_consts)
        if place > 0 or docstring is None or each != docstring
    ]
    arguments = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_exceptiontable, arguments


def _names(code: types.CodeType) -> list[str]:
    """All names in code, attributes among them, and in the code within it."""
    within = [each for each in code.co_consts if isinstance(each, types.CodeType)]
    return [*code.co_names, *(name for each in within for name in _names(each))]


def _global_names(code: types.CodeType) -> list[str]:
    """The names that code, and the code within it, takes from its module; in order, each once."""
    operations, arguments = code.co_code[::2], code.co_code[1::2]
    places, place = [], operations.find(_LOAD_GLOBAL)
    while place >= 0:
        high = arguments[place - 1] << 8 if place and operations[place - 1] == _EXTENDED_ARG else 0
        places.append((high | arguments[place]) >> 1)  # the lowest bit says whether it is called
        place = operations.find(_LOAD_GLOBAL, place + 1)
    names = [code.co_names[place] for place in places]
    for each in code.co_consts:
        if isinstance(each, types.CodeType):
            names += _global_names(each)
    return list(dict.fromkeys(names))


_LOAD_GLOBAL, _EXTENDED_ARG = dis.opmap["LOAD_GLOBAL"], dis.opmap["EXTENDED_ARG"]


def _value(value: Any, reached: list[Function]) -> Any:
    """A value as something whose `repr` is the same in every process, and another for another value."""
    if hasattr(type(value), "described"):  # a kernel, an inner function, a function of lanes
        what, function = value.described()
        return what, None if function is None else _place(function, reached)
    if isinstance(value, enum.Enum):
        return _name(type(value)), value.name, _value(value.value, reached)
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, types.EllipsisType, slice)):
        return type(value).__name__, repr(value)
    if isinstance(value, (tuple, list)):
        return _name(type(value)), [_value(each, reached) for each in value]
    if isinstance(value, (dict, frozenset, set)):
        items = value.items() if isinstance(value, dict) else value
        return _name(type(value)), sorted(repr(_value(each, reached)) for each in items)
    if isinstance(value, (np.ndarray, np.generic)):
        return "array", value.dtype.str, value.shape, value.strides, value.tobytes()
    if isinstance(value, np.dtype):
        return "dtype", value.str
    if isinstance(value, enum.EnumMeta):
        members: list[enum.Enum] = list(value)
        return _name(value), [(each.name, _value(each.value, reached)) for each in members]
    if isinstance(value, type):
        fields = [(name, _value(default, reached)) for name, default in getattr(value, "_field_defaults", {}).items()]
        return _name(value), getattr(value, "_fields", None), fields
    return _reference(value, reached)


def _reference(value: Any, reached: list[Function]) -> Any:
    """A module of Python or NumPy, or a function that is none of ours."""
    if hasattr(value, "py_func"):  # compiled by numba without the help of this package
        return "compiled", _place(value.py_func, reached)
    if isinstance(value, types.ModuleType):
        return value.__name__
    module = str(getattr(value, "__module__", None))
    if isinstance(value, np.ufunc) or (callable(value) and module.partition(".")[0] in FOREIGN):
        return _name(value)
    raise TypeError(f"{value!r} has no version: it is neither a number, an array, an inner function nor a kernel")


def named_by_version(function: Function, version: str) -> Function:
    """The same function by a name that no other one has: numba names machine code by functions' names alone.
    Machine code of two functions of one name, kept by two processes, would be taken for the same by a third."""
    untyped: Any = function
    name = f"{untyped.__qualname__}_{version[:16]}"
    taken = (untyped.__code__, untyped.__globals__, untyped.__name__, untyped.__defaults__, untyped.__closure__)
    named = types.FunctionType(*taken)
    named.__kwdefaults__, named.__module__, named.__qualname__ = untyped.__kwdefaults__, untyped.__module__, name
    return named


def _place(function: Function, reached: list[Function]) -> int:
    if function not in reached:
        reached.append(function)
    return reached.index(function)


def _name(value: Any) -> str:
    name = getattr(value, "__qualname__", None) or value.__name__
    return f"{getattr(value, '__module__', None) or ''}.{name}"


HERE = Path(__file__).resolve().parent
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
    own = b"".join(file.read_bytes() for file in sorted(HERE.glob("*.py")))
    return {
        "compiling": _hex(own), "numba": numba.__version__, "llvmlite": llvmlite.__version__,
        "python": platform.python_version(), "machine": f"{platform.system()} {platform.machine()}",
        "processor": binding.get_host_cpu_name(), "features": binding.get_host_cpu_features().flatten(),
        "settings": json.dumps(settings),
    }  # fmt: skip


@functools.cache
def folder() -> Path | None:
    """The folder for this version, marked as used now; None, with a warning, where there is none and none can be made.
    Folders that were not used for `UNUSED_DAYS` are removed."""
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
    missing: called before the function is compiled, with words that say where it will be kept. compiled: whether it
    was. calls: once loaded or saved, the kernels that the function calls."""

    def __init__(self, path: Path | None, missing: Callable[[str], None]) -> None:
        self.path, self.missing = path, missing
        self.calls: list[Any] = []
        self.compiled = False
        self._lock: Any = None  # held while this process compiles, or until it ends, however that is

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The compiled function of the file; None where there is none, with a warning if it is damaged."""
        if (loaded := self._loaded(signature, target_context)) is not None:
            return loaded
        if self._acquire() and (loaded := self._loaded(signature, target_context)) is not None:
            self.release()
            return loaded  # another process has just compiled it
        kept = "for this process" if self.path is None else f"for this machine, once (kept in {self.path.parent})"
        self.missing(kept)
        self.compiled = True
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
                    self.calls = linking.called(data)
                    _open_runtime(target_context, data)
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
            data = dumps(_alone(result))
            self.calls = linking.called(data)
            if self.path is not None and not result._asdict()["library"].has_dynamic_globals:
                write_whole(self.path, _signature(data) + data)
        except OSError as error:
            warnings.warn(f"compiled kernels are not kept: {error}", stacklevel=2)
        finally:
            self.release()

    def _acquire(self) -> bool:
        """Wait for a process that compiles the same; False where no file can be locked."""
        import filelock  # only now: loading a kernel needs none

        if self.path is None:
            return False
        lock = filelock.FileLock(self.path.with_name(f"{self.path.name}.lock"), thread_local=False)
        try:
            lock.acquire()
        except (OSError, NotImplementedError):  # a folder that can only be read, a file system without locks
            return False
        self._lock = lock
        return True

    def release(self) -> None:
        """Let others compile the same."""
        if self._lock is not None:
            self._lock.release()
            with contextlib.suppress(OSError):
                Path(self._lock.lock_file).unlink()
            self._lock = None


def _open_runtime(target_context: Any, machine_code: bytes) -> None:
    """Let machine code find what it needs of numba; all that compiling needs would take a third of a second more."""
    from numba.core.runtime import rtsys

    if b"_numba_hashsecret" in machine_code:  # of dictionaries and sets, the one name that the rest of numba adds
        target_context.refresh()
    rtsys.initialize(target_context)


def _alone(result: Any) -> Any:
    """What numba keeps of a compiled function, without code for others to link, and constants of functions without any.
    A kernel is called by its address alone."""
    from llvmlite import binding

    (library, kind, (code, _)), *rest, environments = result._reduce()
    names = (result.fndesc.llvm_func_name, result.fndesc.llvm_cpython_wrapper_name)
    defined = binding.parse_assembly("".join(f'define void @"{name}"() {{ ret void }}\n' for name in names))
    used = tuple(environment for environment in environments if environment.consts)
    return (library, kind, (code, defined.as_bitcode())), *rest, used


def _of(signature: Any, result: Any) -> Any:
    """A compiled function by the types of this process: a group of a script or a notebook is another class in each."""
    from numba.core import sigutils, typing

    arguments, _ = sigutils.normalize_signature(signature)
    return result._replace(signature=typing.signature(result.signature.return_type, *arguments))


def _signature(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_SIGNATURE_BYTES).digest()


def _hex(data: bytes) -> str:
    return _signature(data).hex()
