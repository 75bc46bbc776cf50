"""Several scenes at a time, each worker a process of its own that draws one scene after another.

The workers are started as ``python -m fmtorch.data.rendered``: unlike multiprocessing this asks nothing
of the caller's main module, and forks no process that has threads. A worker ends when its input is closed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import fmtorch
from fmtorch import kernels
from fmtorch.data.rendered.generate import KERNELS, Task, generate

Progress = Callable[[int, int], None]
_MOST = 8  # workers; each takes some 0.5 GB
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def generate_all(
    jobs: Sequence[tuple[Task, Path]], workers: int | None = None, progress: Progress | None = None
) -> None:
    """Draws every scene (task, folder) that is missing; `progress` gets (done, total) as scenes are completed.

    workers: processes; by default one for each core that this process may use; 1 draws here.
    Raises RuntimeError if a worker fails.
    """
    total = len(jobs)
    missing = [job for job in jobs if not (job[1] / job[0].name).is_dir()]
    done = total - len(missing)
    report = progress or (lambda done, total: None)
    report(done, total)
    count = min(workers or min(_cores(), _MOST), len(missing))
    if count <= 1:
        for task, folder in missing:
            generate(task, folder)
            done += 1
            report(done, total)
        return
    waiting: queue.SimpleQueue[tuple[Task, Path]] = queue.SimpleQueue()
    for job in missing:
        waiting.put(job)
    finished: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    processes = [_start() for _ in range(count)]
    threads = [threading.Thread(target=_feed, args=(p, waiting, finished), daemon=True) for p in processes]
    try:
        if kernels.available():  # once, while the workers start, rather than in each of them
            kernels.prepare(KERNELS)
        for thread in threads:
            thread.start()
        for _ in missing:
            problem = finished.get()
            if problem is not None:
                raise RuntimeError(f"a worker that drew scenes failed: {problem}")
            done += 1
            report(done, total)
    finally:
        for process in processes:
            if done < total:
                process.terminate()
            assert process.stdin is not None
            process.stdin.close()
            process.wait()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _start() -> subprocess.Popen[str]:
    home = str(Path(fmtorch.__file__).resolve().parents[1])
    path = os.pathsep.join([home, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-m", "fmtorch.data.rendered"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True, env={**os.environ, **_ONE_THREAD, "PYTHONPATH": path},
    )  # fmt: skip


def _feed(
    process: subprocess.Popen[str],
    waiting: queue.SimpleQueue[tuple[Task, Path]],
    finished: queue.SimpleQueue[str | None],
) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    while True:
        try:
            task, folder = waiting.get_nowait()
        except queue.Empty:
            return
        try:
            process.stdin.write(json.dumps({"folder": str(folder), "task": dataclasses.asdict(task)}) + "\n")
            process.stdin.flush()
            answer = process.stdout.readline().strip()
        except (OSError, ValueError) as error:
            answer = str(error)
        problem = None if answer == task.name else f"{task.name}: {answer or 'the process ended (see its messages)'}"
        finished.put(problem)
        if problem is not None:
            return
