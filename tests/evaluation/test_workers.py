"""Workers that are processes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fmtorch import presets
from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.evaluation.run import _shared_out, evaluate_pairs
from fmtorch.pipeline import Pipeline
from fmtorch.storage import PairRow


def _ends() -> Pipeline:
    os._exit(3)


def test_a_process_that_ends_is_told() -> None:
    images = [ImageSource(f"scene/{i}", Path(f"{i}.png")) for i in range(3)]
    pairs = [ImagePair(f"scene/0-{i}", "family", "scene", images[0], images[i], np.eye(3)) for i in (1, 2)]
    rows: list[PairRow] = []
    run = evaluate_pairs(
        presets.pipeline("sift_ratio"), pairs, seed=0, batch=1, workers=2, store=rows.extend, build=_ends
    )
    with pytest.raises(RuntimeError, match="the same command goes on"):
        list(run)
    assert rows == []


WORKER = """
import multiprocessing, time
from fmtorch.evaluation.workers import end_with_parent
def work():
    end_with_parent()
    print(multiprocessing.current_process().pid, flush=True)
    time.sleep(300)
multiprocessing.get_context("fork").Process(target=work).start()
time.sleep(300)
"""


def test_a_worker_ends_with_the_process_that_was_killed() -> None:
    parent = subprocess.Popen([sys.executable, "-c", WORKER], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while alive(worker) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(worker)


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits to be buried does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize(
    ("pairs", "batch", "workers", "size"),
    [(80, 16, 2, 10), (80, 16, 1, 16), (3200, 16, 2, 16), (3, 16, 4, 1), (0, 16, 2, 1)],
)
def test_no_worker_is_long_alone_at_the_end(pairs: int, batch: int, workers: int, size: int) -> None:
    assert _shared_out(pairs, batch, workers) == size
