"""The commands as a user runs them, on small data sets, killed at a chosen moment."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fmtorch.runs import RunFolder

EVAL = ["features.max_features=400", "estimator=lmeds", "estimator.hypotheses=200", "batch=1", "workers=1"]


def evaluation(root: Path, run_dir: Path, *extra: str) -> list[str]:
    """Arguments of an evaluation."""
    return ["dataset=fmbench", f"dataset.root={root}", *EVAL, f"output={run_dir}", *extra]


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
