"""Many kernels compiled by two processes: numba compiles one function at a time in each.

The other process goes through the same kernels from the last to the first and leaves out what the cache folder holds.
Where the two meet, one waits for the other: each kernel's file has a lock."""

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fmtorch.jit import cache, linking
from fmtorch.jit.kernel import Kernel, off
from fmtorch.jobs.execution import cores

HOME = Path(__file__).resolve().parents[2]
_lock = threading.Lock()


def compile_together(kernels: Sequence[Kernel[..., Any]]) -> None:
    """Have kernels ready to be called; those that this machine has not compiled yet are compiled, with messages.
    An inner function is compiled in each process that needs it: kernels that share many should stand side by side, the
    slowest at both ends. Raises ImportError where numba cannot be imported."""
    if off() or all(each.ready for each in kernels):
        return
    with _lock:
        absent = [each for each in kernels if not (each.ready or each.kept)]
        with _helped([*reversed(absent)]):
            for number, each in enumerate(absent, start=1):
                each.compiled_alone(f"{number} of {len(absent)}: ")
        for each in kernels:
            each.compiled()


@contextlib.contextmanager
def _helped(kernels: Sequence[Kernel[..., Any]]) -> Iterator[None]:
    """Within it another process compiles these kernels, too, where that can be started and is of use."""
    if len(kernels) < 2 or cores() < 2 or cache.folder() is None:
        yield
        return
    names = [f"{each.function.__module__}:{each.function.__qualname__}" for each in kernels]
    path = os.pathsep.join([str(HOME), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        helper = subprocess.Popen(
            [sys.executable, "-m", __name__, *names], env={**os.environ, "PYTHONPATH": path},
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError:
        yield
        return
    with helper:
        try:
            yield
        finally:
            helper.terminate()


def main() -> None:
    """Compile the kernels that the arguments name, ``module:function``; end with the process that asked for it."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    for name in sys.argv[1:]:
        kernel = linking.kernel_of(*name.split(":"))
        if not kernel.kept:
            kernel.compiled_alone()


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
