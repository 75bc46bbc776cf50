"""What is said while kernels are compiled: one line, however many there are.

A terminal shows which one it is and forgets the line when all is done; a log gets the first message alone.
"""

from __future__ import annotations

import sys

_CLEAR = "\r\x1b[K"
_state = {"announced": False}


def begun(name: str, where: str, count: str = "") -> None:
    """Say that a kernel is compiled, on the error stream. where: it is kept. count: which one of how many it is."""
    if sys.stderr.isatty():
        print(f"{_CLEAR}{count}compiling {name} {where}", end="", file=sys.stderr, flush=True)
    elif not _state["announced"]:
        print(f"{count}compiling {name} and what else is missing {where}", file=sys.stderr, flush=True)
    _state["announced"] = True


def ended() -> None:
    """Take the line back from a terminal."""
    if sys.stderr.isatty():
        print(_CLEAR, end="", file=sys.stderr, flush=True)
