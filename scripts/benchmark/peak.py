"""By how much a call makes its process grow at its peak."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

PROC = Path("/proc/self")


def peak_growth(call: Callable[[], Any]) -> float:
    """MiB, the peak of the resident set during a call beyond what was resident before it.

    What the process claimed before, as for compiled kernels, does not hide it. Raises SystemExit where the kernel does
    not tell peaks anew, as anywhere but on Linux.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # what was freed is given back, or the call would use it
    if trim is not None:
        trim(0)
    try:
        (PROC / "clear_refs").write_text("5")  # the peak is counted from here
        before = _resident("VmRSS")
        call()
        return (_resident("VmHWM") - before) / 1024
    except OSError as error:
        raise SystemExit(f"peaks of memory can be measured on Linux alone ({error})") from None


def _resident(field: str) -> int:
    """kB; of the process itself, whereas ru_maxrss is inherited."""
    lines = (PROC / "status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field))
