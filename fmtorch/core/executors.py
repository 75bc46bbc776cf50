"""Executors that work is given to: threads, processes, a cluster of dask, or any other of `concurrent.futures`."""

from __future__ import annotations

import dataclasses
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any, cast

import cv2
import torch

KINDS = ("auto", "threads", "processes", "dask")
MAX_PROCESSES = 8  # unless more are asked for: each may hold networks and some 0.5 GB
MIN_PAIRS_FOR_PROCESSES = 1000  # of given matches, start included: 10.0 s by one thread, 8.4 by two processes
SHARED_BY = "file_system"  # tensors between processes: 1,225 pairs of a folder in 22 s, by file descriptors in 27
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkersLost(ConnectionError):
    """Workers, or the scheduler, that are there no more; what was stored is kept."""


@dataclasses.dataclass(frozen=True)
class Execution:
    """Where work is done.

    kind: one of `KINDS`; of "auto" the caller makes one of the others. workers: how many; None: one a core, those of
    the cluster, or as many as `make` has. address: of a scheduler of dask; None: a cluster on this machine.
    send_images: whether images go to the workers as bytes. make: anybody's executor, in place of a kind.
    """

    kind: str = "threads"
    workers: int | None = None
    address: str | None = None
    send_images: bool = False
    make: Callable[[], Executor] | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"executor={self.kind}; it must be one of {', '.join(KINDS)}")
        if self.address is not None and self.kind != "dask":
            raise ValueError(f"executor.address={self.address} is that of a cluster; give executor=dask with it")

    @property
    def shared(self) -> bool:
        """Whether workers are threads of this process."""
        return self.make is None and self.kind == "threads"

    def decided(self, processes: bool) -> Execution:
        """The same with "auto" as processes, or as threads: one worker is a thread in any case."""
        several = (self.workers or os.cpu_count() or 1) > 1
        kind = "processes" if processes and several else "threads"
        return self if self.kind != "auto" else dataclasses.replace(self, kind=kind)


class Team:
    """An executor of an `Execution`, started at its first call, and made anew where it broke.

    preload: modules that processes import before they are forked.
    """

    def __init__(
        self, execution: Execution, preload: Sequence[str] = ("fmtorch.core.calls",), most: int | None = None
    ) -> None:
        self.execution, self.preload = execution, preload
        cores = os.cpu_count() or 1
        count = execution.workers or (min(cores, MAX_PROCESSES) if execution.kind == "processes" else cores)
        self.size = max(1, count if most is None else min(count, most))
        self._executor: Executor | None = None
        self._cluster: Any = None

    @property
    def executor(self) -> Executor:
        """The executor that works now."""
        if self._executor is None:
            self._executor = self._started()
        return self._executor

    @property
    def ahead(self) -> int:
        """How many calls are to be under way: all workers busy, and one call waiting for the first that is free."""
        return self.size + 1 if self._cluster is None else 2 * self._cluster.threads()

    def renew(self) -> None:
        """Another executor in place of one that broke."""
        if self._executor is not None and self._cluster is None:
            self._executor.shutdown(wait=False)
            self._executor = None

    def close(self) -> None:
        """Wait for what is under way; what has not begun must have been cancelled."""
        if self._cluster is not None:
            self._cluster.close()
        elif self._executor is not None:
            self._executor.shutdown(wait=True)
        self._executor = self._cluster = None

    def lost(self, error: BaseException) -> WorkersLost | None:
        """What to say where an error means that the scheduler is gone."""
        if self._cluster is None or not self._cluster.lost(error):
            return None
        return WorkersLost(
            f"the scheduler at {self._cluster.address} was lost; with another, the same command goes on from here"
        )

    def _started(self) -> Executor:
        execution = self.execution
        if execution.make is not None:
            try:
                executor = execution.make()
            except Exception as error:  # of anybody's code
                raise ValueError(f"executor: it cannot be made ({type(error).__name__}: {error})") from error
            if not isinstance(executor, Executor):
                raise ValueError(f"executor: {type(executor).__name__} is no concurrent.futures.Executor")
            self.size = execution.workers or int(getattr(executor, "_max_workers", 0)) or self.size
            return executor
        if execution.kind == "dask":
            from fmtorch.core.cluster import Cluster

            self._cluster = Cluster(execution.address, self.size)
            return cast(Executor, self._cluster.executor)
        return self._processes() if execution.kind == "processes" else ThreadPoolExecutor(self.size)

    def _processes(self) -> Executor:
        """Forked of a process that has no threads, where there is fork; each has the environment of this one."""
        spawned = "forkserver" not in multiprocessing.get_all_start_methods() or sys.platform == "darwin"
        context = multiprocessing.get_context("spawn" if spawned else "forkserver")
        if not spawned:
            context.set_forkserver_preload(list(self.preload))
        environment = {**os.environ, **_ONE_THREAD}
        return ProcessPoolExecutor(self.size, context, initializer=_begin, initargs=(environment,))


def _begin(environment: Mapping[str, str]) -> None:
    """The start of a process: an interrupt is for the one that asked, which waits for what is under way."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    os.environ.clear()
    os.environ.update(environment)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.multiprocessing.set_sharing_strategy(SHARED_BY)  # type: ignore[no-untyped-call]


def end_with_parent() -> None:
    """Have this process end when the one that started it does, however that does: a worker would wait forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
