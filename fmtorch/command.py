"""What the commands share: the console, plain parts of a config, and how errors end a command."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from omegaconf import DictConfig, OmegaConf
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

console = Console()


def plain(config: Any) -> dict[str, Any]:
    """A part of a config as a dictionary without interpolations; empty for null."""
    container = OmegaConf.to_container(config, resolve=True) if isinstance(config, DictConfig) else {}
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def progress_bars() -> Progress:
    """Progress bars on the terminal's error stream, as all commands show them; a context manager."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=Console(stderr=True))


def reporter(progress: Progress, description: str) -> Callable[[int, int], None]:
    """A function of (done, total) that shows a bar from its first call on."""
    bar: list[TaskID] = []

    def report(done: int, total: int) -> None:
        if not bar:
            bar.append(progress.add_task(description, total=total))
        progress.update(bar[0], completed=done, total=total)

    return report


@contextlib.contextmanager
def exits_with_message(interrupted: str = "interrupted") -> Iterator[None]:
    """Ends the process with status 1 and one line for what a user can put right, rather than with a traceback."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(interrupted)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
