"""What the commands share: the console, progress bars, and how errors end a command."""

import contextlib
import functools
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from rich import progress as bars
from rich.console import Console

from fmtorch.core.failures import place_of

console = Console(markup=False, highlight=False)  # paths and names may hold brackets; styles are given by style=...
errors = Console(stderr=True, markup=False, highlight=False)
LINE_SECONDS = 60.0  # between two lines of progress where there is no terminal
MISTAKES = (ValueError, OSError, ImportError)  # what a user can put right


class _Bars(bars.Progress):
    """Bars on a terminal, from the first task on; where there is none, as in a log, a line every `LINE_SECONDS`."""

    _said = math.inf

    def start(self) -> None:
        """Nothing yet: an error before the first task stands alone."""

    def stop(self) -> None:
        if self.live.is_started:
            super().stop()

    def add_task(self, *about: Any, **options: Any) -> bars.TaskID:
        if not self.live.is_started:
            self._said = time.monotonic()
            super().start()
        return super().add_task(*about, **options)

    def update(self, task_id: bars.TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        self._say(task_id)

    def advance(self, task_id: bars.TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._say(task_id)

    def _say(self, task_id: bars.TaskID) -> None:
        if self.console.is_terminal or time.monotonic() - self._said < LINE_SECONDS:
            return
        self._said = time.monotonic()
        task = self._tasks[task_id]
        total = "" if task.total is None else f" of {task.total:,.0f}"
        line = f"{task.description}: {task.completed:,.0f}{total} after {(task.elapsed or 0) / 60:.0f} min"
        print(line, file=sys.stderr, flush=True)


def progress_bars() -> bars.Progress:
    """Progress bars on the terminal's error stream, as all commands show them; a context manager."""
    counts = bars.MofNCompleteColumn(), bars.TimeElapsedColumn(), bars.TimeRemainingColumn()
    return _Bars(bars.TextColumn("{task.description}", markup=False), bars.BarColumn(), *counts, console=errors)


def reporter(progress: bars.Progress, description: str) -> Callable[[int, int], None]:
    """A function of (done, total) that shows a bar from its first call on."""
    bar: list[bars.TaskID] = []

    def report(done: int, total: int) -> None:
        if not bar:
            bar.append(progress.add_task(description, total=total))
        progress.update(bar[0], completed=done, total=total)

    return report


def error_line(error: BaseException) -> str:
    """An error in one line, with the path that an OSError is about, and where a user's own code raised it."""
    text = str(error) if isinstance(error, MISTAKES) else f"{type(error).__name__}: {error}"
    if isinstance(error, OSError) and error.strerror and error.errno is not None:
        paths = [str(path) for path in (error.filename, error.filename2) if path is not None]
        text = f"{' -> '.join(paths)}: {error.strerror}" if paths else error.strerror
    place = place_of(error)
    return " ".join(text.split()) + (f" ({place})" if place and place not in text else "")


@contextlib.contextmanager
def exits_with_message(interrupted: str = "interrupted") -> Iterator[None]:
    """Ends the process with status 1 and one line for what a user can put right, rather than with a traceback.
    Interrupted, with status 130 and a line: `interrupted`, and what was kept. Warnings within are a line each, once."""
    with warnings.catch_warnings():
        say = functools.cache(lambda text: errors.print(text, soft_wrap=True))
        warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
        try:
            yield
        except KeyboardInterrupt as stop:
            print(f"{interrupted}; {stop}" if str(stop) else interrupted, file=sys.stderr)
            sys.exit(130)
        except MISTAKES as error:
            sys.exit(f"error: {error_line(error)}")
