"""Many kernels compiled by two processes: numba compiles one function at a time in each.

The other process runs `main` (`fmtorch.jit.process`), which is told one kernel a line and keeps what it compiles
in the cache folder. It ends when its input is closed; what it did not compile is compiled here.
"""

from __future__ import annotations

import collections
import contextlib
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import Any

from fmtorch.jit import cache, kernel, linking, process
from fmtorch.jit.kernel import Kernel

_lock = threading.Lock()


def compile_together(kernels: Sequence[Kernel[..., Any]]) -> None:
    """Have kernels ready to be called; those that this machine has not compiled yet are compiled, with messages.

    This process begins at the first, the other at the last. An inner function is compiled in each process that needs
    it: kernels that share many should stand side by side, the slowest at both ends. Raises ImportError where numba
    cannot be imported.
    """
    if kernel.off() or all(each.ready for each in kernels):
        return
    with _lock:
        absent = [each for each in kernels if not (each.ready or each.kept)]
        jobs = [(f"{number} of {len(absent)}: ", each) for number, each in enumerate(absent, start=1)]
        waiting = collections.deque(jobs)
        helper = _helper() if len(absent) > 1 and process.cores() > 1 and cache.folder() is not None else None
        try:
            if helper is not None:
                threading.Thread(target=_feed, args=(helper, waiting), daemon=True).start()
            with contextlib.suppress(IndexError):  # the other process took the last one
                while waiting:
                    count, each = waiting.popleft()
                    each.compiled_alone(count)
        except BaseException:
            if helper is not None:
                helper.terminate()
            raise
        finally:
            if helper is not None:
                assert helper.stdin is not None
                waiting.clear()
                with contextlib.suppress(OSError):
                    helper.stdin.close()
                helper.wait()
        for each in kernels:
            each.compiled()


def _helper() -> subprocess.Popen[str] | None:
    """The other process; None where it cannot be started."""
    try:
        return process.start("fmtorch.jit.together", **{kernel.QUIET: "1"})
    except OSError:
        return None


def _feed(helper: subprocess.Popen[str], waiting: collections.deque[tuple[str, Kernel[..., Any]]]) -> None:
    """Gives the other process one kernel after the other, from the last; ends when none waits or it has ended."""
    assert helper.stdin is not None
    assert helper.stdout is not None
    with contextlib.suppress(IndexError, OSError, ValueError):  # none waits, or the pipe is closed
        while helper.stdout.readline():  # it is ready for one
            count, each = waiting.pop()
            helper.stdin.write(f"{each.__module__} {each.__qualname__} {count}\n")  # type: ignore[attr-defined]
            helper.stdin.flush()


def main() -> None:
    """Compile the kernels that standard input names, one line each, and ask for the next by a line."""
    print("ready", flush=True)
    for line in sys.stdin:
        module, name, count = line.rstrip("\n").split(" ", 2)
        linking.kernel_of(module, name).compiled_alone(count)
        print(name, flush=True)
