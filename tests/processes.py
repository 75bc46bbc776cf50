"""Commands in processes of their own, started quickly, and killed at a chosen moment."""

from __future__ import annotations

import atexit
import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tests.conftest import own_cache

SOURCE = Path(__file__).resolve().parents[1]
ENVIRONMENT = dict(os.environ)  # before any test changes it
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
PATIENCE = 1200.0  # seconds after which a command hangs


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits to be buried does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def peak_memory() -> int:
    """Bytes that this process has held at most; not ru_maxrss, which it inherits from the one that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmHWM")))


class Command:
    def __init__(self, starter: Starter, pid: int, log: Path) -> None:
        self._starter, self.pid, self.log = starter, pid, log
        self.status: int | None = None

    def kill(self) -> bool:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        return self.wait() == -signal.SIGKILL

    def wait(self) -> int:
        if self.status is None:
            self.status = self._starter.ask({"wait": self.pid})
        return self.status

    def runs(self) -> bool:
        """Whether it has not ended, killed or by itself."""
        return alive(self.pid)

    def kill_when(self, reached: Callable[[], bool], later: float = 0.0) -> bool:
        """Kill it `later` seconds after something is so; whether it was still running then."""
        deadline = time.monotonic() + PATIENCE
        while not reached() and self.runs() and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(later)
        return self.kill()

    def said(self) -> str:
        return self.log.read_text(errors="replace")


class Starter:
    """A process with the libraries imported, which forks commands; see `starter`."""

    def __init__(self) -> None:
        environment = {**ENVIRONMENT, **ONE_THREAD, "PYTHONPATH": str(SOURCE), "COLUMNS": "200"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.starter"], cwd=SOURCE, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self._count = 0

    def ask(self, job: dict[str, Any]) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def start(
        self, cwd: Path, name: str, *arguments: str, before: str = "", log: Path | None = None,
        errors: Path | None = None, environment: Mapping[str, str] | None = None,
    ) -> Command:  # fmt: skip
        """``python -m fmtorch <name> arguments`` in a folder; before: Python code that runs first.
        name: of a command, or of a module, or ``-c``, before code to run. log, errors: files for standard output and
        standard error, which go into one in the folder if not given."""
        self._count += 1
        log = log or cwd / f"{name}-{self._count}.log"
        own = {"FMTORCH_CACHE": str(own_cache(cwd)), "PYTHONPATH": str(SOURCE), **(environment or {})}
        start = [name] if name.startswith(("scripts.", "tests.", "fmtorch.", "-c")) else ["fmtorch", name]
        job = {
            "start": [*start, *arguments], "cwd": str(cwd), "log": str(log), "errors": str(errors or log),
            "environment": own, "before": before,
        }  # fmt: skip
        return Command(self, self.ask(job), log)

    def run(self, cwd: Path, name: str, *arguments: str, before: str = "") -> Command:
        command = self.start(cwd, name, *arguments, before=before)
        command.wait()
        return command

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


@functools.cache
def starter() -> Starter:
    """The process that starts the commands of this test process."""
    started = Starter()
    atexit.register(started.close)
    return started


def run_command(
    name: str, *arguments: str, cwd: Path, environment: Mapping[str, str] | None = None, patience: float = 300.0
) -> subprocess.CompletedProcess[str]:
    """``python -m fmtorch <name> arguments`` as a user runs it in a folder, to its end (names as of `Starter.start`).
    The process is forked from one that has imported the libraries, which saves seconds, and has a cache of its own.
    Raises TimeoutError."""
    with tempfile.TemporaryDirectory() as folder:
        log, errors = (Path(folder) / stream for stream in ("out", "errors"))
        command = starter().start(cwd, name, *arguments, log=log, errors=errors, environment=environment)
        deadline = time.monotonic() + patience
        while command.runs():
            if time.monotonic() > deadline:
                command.kill()
                raise TimeoutError(f"{name} {' '.join(arguments)}: {log.read_text()}{errors.read_text()}")
            time.sleep(0.05)
        return subprocess.CompletedProcess([name, *arguments], command.wait(), log.read_text(), errors.read_text())
