"""What the commands share: the console, progress bars, and how errors end a command."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from fmtorch.core.failures import place_of

console = Console(markup=False)  # paths and names may hold brackets; styles are given by style=...
errors = Console(stderr=True, markup=False)
MISTAKES = (ValueError, OSError, ImportError)  # what a user can put right


def progress_bars() -> Progress:
    """Progress bars on the terminal's error stream, as all commands show them; a context manager."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=errors)


def reporter(progress: Progress, description: str) -> Callable[[int, int], None]:
    """A function of (done, total) that shows a bar from its first call on."""
    bar: list[TaskID] = []

    def report(done: int, total: int) -> None:
        if not bar:
            bar.append(progress.add_task(description, total=total))
        progress.update(bar[0], completed=done, total=total)

    return report


def error_line(error: BaseException) -> str:
    """An error in one line, with the path that an OSError is about, and where a user's own code raised it."""
    text = str(error)
    if not isinstance(error, MISTAKES):
        text = f"{type(error).__name__}: {text}"
    if isinstance(error, OSError) and error.strerror and error.errno is not None:
        paths = [str(path) for path in (error.filename, error.filename2) if path is not None]
        text = f"{' -> '.join(paths)}: {error.strerror}" if paths else error.strerror
    place = place_of(error)
    return " ".join(text.split()) + (f" ({place})" if place and place not in text else "")


@contextlib.contextmanager
def exits_with_message(interrupted: str = "interrupted") -> Iterator[None]:
    """Ends the process with status 1 and one line for what a user can put right, rather than with a traceback."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(interrupted)
    except MISTAKES as error:
        sys.exit(f"error: {error_line(error)}")
