"""`FMTORCH_KERNELS=off`: estimators run their kernels interpreted by Python, all else takes its tensor form."""

from __future__ import annotations

import functools
import os
import warnings

SWITCH = "FMTORCH_KERNELS"


def off() -> bool:
    """Whether kernels are switched off. Raises ValueError if $FMTORCH_KERNELS is neither on nor off."""
    switch = os.environ.get(SWITCH, "")
    if switch not in ("", "on", "off"):
        raise ValueError(f"{SWITCH}={switch}; it must be on or off")
    return switch == "off"


def available() -> bool:
    """Whether kernels stand for tensor forms: not switched off, and numba is there; a warning says once that it is not.

    Raises ValueError if $FMTORCH_KERNELS is neither on nor off.
    """
    return not off() and numba_version() is not None


@functools.cache
def numba_version() -> str | None:
    """The version of numba, None, with a warning, where it cannot be imported."""
    try:
        import numba
    except (ImportError, OSError) as error:
        reason = str(error).partition("\n")[0]
        warnings.warn(f"without numba ({reason}) the slower tensor and NumPy forms are used", stacklevel=3)
        return None
    return str(numba.__version__)


def identity() -> str:
    """What a run says of its kernels: ``numba 0.68.1``, or ``off``."""
    return f"numba {numba_version()}" if available() else "off"
