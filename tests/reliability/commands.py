"""The commands as a user runs them, on small data sets, killed at a chosen moment."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.storage import RunFolder
from tests.test_pipeline import draw

SOURCE = Path(__file__).resolve().parents[2]
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
EVAL = ["features.max_features=400", "estimator=lmeds", "estimator.hypotheses=200", "batch=1", "workers=1"]
SIDEWAYS = "0 0 0 0 0 -1 0 1 0"
PATIENCE = 1200.0  # seconds after which a command hangs


class Command:
    """A command that runs."""

    def __init__(self, starter: Starter, pid: int, log: Path) -> None:
        self._starter, self.pid, self.log, self.status = starter, pid, log, None

    def kill(self) -> bool:
        """Kill it; whether it was still running."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        return self.wait() == -signal.SIGKILL

    def wait(self) -> int:
        """The exit status."""
        if self.status is None:
            self.status = self._starter.ask({"wait": self.pid})
        return self.status

    def runs(self) -> bool:
        """Whether it has not ended, killed or by itself."""
        try:
            state = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return False
        return state != "Z"

    def kill_when(self, reached: Callable[[], bool], later: float = 0.0) -> bool:
        """Kill it `later` seconds after something is so; whether it was still running then."""
        deadline = time.monotonic() + PATIENCE
        while not reached() and self.runs() and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(later)
        return self.kill()

    def said(self) -> str:
        """All that it wrote to the terminal."""
        return self.log.read_text(errors="replace")


class Starter:
    """A process with the libraries imported, which forks commands; see `starter`."""

    def __init__(self) -> None:
        environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(SOURCE), "COLUMNS": "200"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.reliability.starter"], cwd=SOURCE, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self._count = 0

    def ask(self, job: dict[str, Any]) -> int:
        """The answer to one line."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def start(self, cwd: Path, name: str, *arguments: str, before: str = "") -> Command:
        """``python -m fmtorch.<name> arguments`` in a folder; before: Python code that runs first."""
        self._count += 1
        log = cwd / f"{name}-{self._count}.log"
        environment = {"FMTORCH_CACHE": f"{cwd}/cache", "PYTHONPATH": str(SOURCE)}
        start = [f"fmtorch.{name}", *arguments]
        job = {"start": start, "cwd": str(cwd), "log": str(log), "environment": environment, "before": before}
        return Command(self, self.ask(job), log)

    def run(self, cwd: Path, name: str, *arguments: str, before: str = "") -> Command:
        """The same to its end."""
        command = self.start(cwd, name, *arguments, before=before)
        command.wait()
        return command

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def data_set(folder: Path, scenes: int, images: int) -> Path:
    """Scenes of images moved sideways, in the layout of FM-Bench; pairs of neighbours."""
    lines, names = [], []
    for scene in range(scenes):
        place = folder / f"scene{scene}" / "Images"
        place.mkdir(parents=True)
        for i in range(images):
            draw(place / f"{i:08d}.png", seed=scene, shift=9 * i)
        for i in range(images - 1):
            lines.append(f"{i} {i + 1} {SIDEWAYS}")
            names.append(f"scene{scene}/")
    (folder / "pairs_with_gt.txt").write_text("\n".join(lines) + "\n")
    (folder / "pairs_which_dataset.txt").write_text("\n".join(names) + "\n")
    return folder


def evaluation(root: Path, run_dir: Path, *extra: str) -> list[str]:
    """Arguments of an evaluation."""
    return ["dataset=fmbench", f"dataset.root={root}", *EVAL, f"run_dir={run_dir}", *extra]


def results(run_dir: Path) -> list[dict[str, object]]:
    """The rows of a run, in the order of pairs, without what depends on the time."""
    rows = RunFolder.load(run_dir).read().to_pylist()
    kept = [{k: v for k, v in row.items() if not k.startswith("seconds")} for row in rows]
    return sorted(kept, key=lambda row: str(row["pair"]))


def parts(run_dir: Path) -> int:
    """How many parts a run has on disk."""
    return len(list((run_dir / "pairs").glob("part-*.parquet")))


def delays(seed: int) -> Iterator[float]:
    """Seconds between what is waited for and the kill: none at all, within a pair's time, and beyond."""
    rng = np.random.default_rng(seed)
    while True:
        yield float(rng.choice([0.0, 0.0, rng.uniform(0, 0.02), rng.uniform(0, 0.2)]))


@contextlib.contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[Path]:
    """A file system of so many kilobytes, mounted on the folder. Raises OSError where that is not allowed."""
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if done.returncode:
        raise OSError(done.stderr.decode().strip())
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def remount(folder: Path, options: str) -> None:
    """Change a mounted file system: ``size=9m``, ``ro``, ``rw``."""
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)
