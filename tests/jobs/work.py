"""What workers do; in a module of its own, which their processes import quickly."""

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any


def make_needs(folder: Path, size: int = 0) -> tuple[Path, bytes]:
    """What workers need; each process that makes it leaves a file."""
    (folder / f"made-{os.getpid()}-{time.monotonic_ns()}").touch()
    return folder, bytes(size)


def squares(needed: tuple[Path, bytes], numbers: list[int]) -> list[int]:
    """The squares; a negative number ends the process, after it has left a file."""
    folder = needed[0]
    for number in numbers:
        if number < 0:
            (folder / f"died-{time.monotonic_ns()}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return [number * number for number in numbers]


def ends(folder: Path) -> Any:
    """A factory that ends the process."""
    os._exit(3)


def fails(needed: object, job: int) -> int:
    raise ValueError(f"job {job} is wrong")


def slow(event: threading.Event, job: int) -> int:
    if job:
        event.wait(60)
    return job


def late(value: None, job: int) -> int:
    time.sleep(0.05 if job % 3 == 0 else 0)
    return -job
