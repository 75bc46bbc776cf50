"""Several scenes at a time, each worker a process of its own that draws one scene after another.

The workers run `main` in processes of their own (`fmtorch.compiling.process`): unlike multiprocessing this asks
nothing of the caller's main module, and forks no process that has threads. A worker ends when its input is closed.
"""

from __future__ import annotations

import dataclasses
import json
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from fmtorch.compiling import process
from fmtorch.compiling.together import compile_together
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
    count = min(workers or min(process.cores(), _MOST), len(missing))
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
    processes = [process.start("fmtorch.data.rendered.workers", **_ONE_THREAD) for _ in range(count)]
    threads = [threading.Thread(target=_feed, args=(p, waiting, finished), daemon=True) for p in processes]
    try:
        compile_together(KERNELS)  # once, while the workers start, rather than in each of them
        for thread in threads:
            thread.start()
        for _ in missing:
            problem = finished.get()
            if problem is not None:
                raise RuntimeError(f"a worker that drew scenes failed: {problem}")
            done += 1
            report(done, total)
    finally:
        for worker in processes:
            if done < total:
                worker.terminate()
            assert worker.stdin is not None
            worker.stdin.close()
            worker.wait()


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


def main() -> None:
    """Draw the scenes that standard input names, one JSON object a line, and tell of each when it is complete."""
    for line in sys.stdin:
        job = json.loads(line)
        task = Task.from_json(json.dumps(job["task"]))
        generate(task, Path(job["folder"]))
        print(task.name, flush=True)
