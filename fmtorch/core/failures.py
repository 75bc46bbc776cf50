"""Where a user's own code failed: its file, line and traceback, apart from the frames of libraries."""

import functools
import sysconfig
import traceback
from pathlib import Path

from fmtorch.core.files import PACKAGE

INSTALLED = ("site-packages", "dist-packages")  # folders of other people's code, which is not looked into


def place_of(error: BaseException) -> str:
    """``my_part.py:12, in helper``: the innermost line of a user's own code on the way to an error; mostly empty."""
    own = [frame for frame in _frames(_cause(error)) if _is_own(frame.filename)]
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}, in {own[-1].name}" if own else ""


def in_a_line(error: BaseException) -> str:
    """The kind of an error, its first line, and its `place_of`."""
    place = place_of(error)
    return f"{type(error).__name__}: {error}".splitlines()[0] + (f" ({place})" if place else "")


def own_traceback(error: BaseException) -> str:
    """The traceback of an error from the user's own code on; empty where none took part."""
    cause = _cause(error)
    frames = _frames(cause)
    first = next((i for i, frame in enumerate(frames) if _is_own(frame.filename)), None)
    if first is None:
        return ""
    return "".join([*traceback.format_list(frames[first:]), *traceback.format_exception_only(cause)]).rstrip()


def _cause(error: BaseException) -> BaseException:
    """The error itself, or the one behind it (`raise ... from`) that the user's own code raised."""
    cause: BaseException | None = error
    while cause is not None and not any(_is_own(frame.filename) for frame in _frames(cause)):
        cause = cause.__cause__
    return cause or error


def _frames(error: BaseException) -> list[traceback.FrameSummary]:
    """Its frames from this project's first one on, without its caller's; a file that cannot be compiled is the last."""
    frames = list(traceback.extract_tb(error.__traceback__))
    first = next((i for i, frame in enumerate(frames) if Path(frame.filename).is_relative_to(PACKAGE)), 0)
    frames = frames[first:]
    if isinstance(error, SyntaxError) and error.filename:
        frames.append(traceback.FrameSummary(error.filename, error.lineno, "<module>", line=error.text))
    return frames


@functools.cache
def _is_own(file: str) -> bool:
    """Whether a file is neither of this project, nor of an installed package, nor of Python."""
    if file.startswith("<") and not file.startswith("<ipython"):
        return False
    if file.endswith((".pyx", ".pxd", ".pxi")):  # as compiled extensions name their sources, such as HDF5's
        return False
    path, library = Path(file).resolve(), Path(sysconfig.get_path("stdlib")).resolve()
    return not (set(INSTALLED) & set(path.parts) or path.is_relative_to(PACKAGE) or path.is_relative_to(library))
