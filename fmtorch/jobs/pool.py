"""Workers: threads, processes, a cluster of Dask, or any executor of `concurrent.futures`."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
import types
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any, cast

import torch

from fmtorch.jobs.execution import Execution, cores
from fmtorch.jobs.threads import use_one_thread

MAX_PROCESSES = 8  # unless more are asked for: each may hold networks and some 0.5 GB
SHARED_BY = "file_system"  # tensors between processes: 1,225 pairs of a folder in 22 s, by file descriptors in 27
SECONDS_TO_CONNECT = 10.0
SECONDS_FOR_WORKERS = 60.0
SECONDS_BETWEEN_COUNTS = 2.0
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkersLost(ConnectionError):
    """Workers, or the scheduler, that are there no more; what was stored is kept."""


class WorkerPool:
    """The workers of an `Execution`, started at their first task, and replaced where they broke; a context manager.

    Args:
        execution: which workers. preload: modules that processes import before they are forked. limit: workers at
            most. needs_main: whether tasks may be of the caller's main module, which processes then import: a script
            needs ``if __name__ == "__main__"``.
    """

    def __init__(
        self, execution: Execution, preload: Sequence[str] = ("fmtorch.jobs.runner",), limit: int | None = None,
        needs_main: bool = True,
    ) -> None:  # fmt: skip
        self.execution, self.preload, self.needs_main = execution, preload, needs_main
        count = execution.workers or (min(cores(), MAX_PROCESSES) if execution.kind == "processes" else cores())
        self.size = max(1, count if limit is None else min(count, limit))
        self._executor: Executor | None = None
        self._cluster: _Cluster | None = None

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def executor(self) -> Executor:
        """The executor that works now."""
        if self._executor is None:
            self._executor = self._started()
        return self._executor

    @property
    def ahead(self) -> int:
        """How many tasks are to be under way: all workers busy, and one task waiting for the first that is free."""
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
            self._cluster = _Cluster(execution.address, self.size)
            return self._cluster.executor
        return self._processes() if execution.kind == "processes" else ThreadPoolExecutor(self.size)

    def _processes(self) -> Executor:
        """Forked of a process that has no threads, where there is fork; each has the environment of this one."""
        spawned = "forkserver" not in multiprocessing.get_all_start_methods() or sys.platform == "darwin"
        context = multiprocessing.get_context("spawn" if spawned else "forkserver")
        if not spawned:
            context.set_forkserver_preload(list(self.preload))
        pool = ProcessPoolExecutor if self.needs_main else _WithoutMain
        environment = {**os.environ, **_ONE_THREAD}
        return pool(self.size, context, initializer=_begin, initargs=(environment,))


class _WithoutMain(ProcessPoolExecutor):
    """Processes that do not import this one's main module: they start within `submit`, as if it were empty."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As of the base class."""
        main = sys.modules["__main__"]
        sys.modules["__main__"] = types.ModuleType("__main__")
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            sys.modules["__main__"] = main


def _begin(environment: Mapping[str, str]) -> None:
    """The start of a process: an interrupt is for the one that asked, which waits for what is under way."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    os.environ.clear()
    os.environ.update(environment)
    use_one_thread()
    torch.multiprocessing.set_sharing_strategy(SHARED_BY)  # type: ignore[no-untyped-call]


def end_with_parent() -> None:
    """Have this process end when the one that started it does, however that does: a worker would wait forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class _Cluster:
    """A client of a scheduler of dask.distributed, one that runs or one of this machine.

    Raises ImportError without Dask, and ValueError where nobody answers at the address or no worker comes.
    """

    def __init__(self, address: str | None, workers: int) -> None:
        try:
            import distributed
        except ImportError as error:
            raise ImportError("executor=dask needs dask and distributed: pip install 'fmtorch[dask]'") from error
        self._local: Any = None
        if address is None:
            # What workers log of a worker that died, and of their own end, is ours to say.
            self._local = distributed.LocalCluster(
                workers, threads_per_worker=1, dashboard_address=None, silence_logs=50, protocol="tcp"
            )
        try:
            self.client = distributed.Client(self._local or address, timeout=SECONDS_TO_CONNECT, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(
                f"executor.address={address}: no scheduler answers; start one by `dask scheduler`, or leave the "
                "address out for a cluster on this machine"
            ) from error
        self.address = str(address or self._local.scheduler_address)
        try:
            self.client.wait_for_workers(1, timeout=SECONDS_FOR_WORKERS)
        except TimeoutError as error:
            self.close()
            raise ValueError(
                f"executor.address={address}: the scheduler has no workers; start some by `dask worker {address}`"
            ) from error
        self.executor = cast(Executor, self.client.get_executor(pure=False))
        self._threads, self._counted = 1, 0.0

    def threads(self) -> int:
        """How many tasks the workers do at a time, counted now and then: workers join and leave."""
        if time.monotonic() - self._counted > SECONDS_BETWEEN_COUNTS:
            try:
                self._threads = max(1, sum(self.client.nthreads().values()))
            except (OSError, TimeoutError, CancelledError):
                return self._threads  # the tasks will tell
            self._counted = time.monotonic()
        return self._threads

    def lost(self, error: BaseException) -> bool:
        """Whether an error of a task, which nobody cancelled, means that the scheduler is gone."""
        return isinstance(error, CancelledError) or self.client.status != "running"

    def close(self) -> None:
        """Leave the cluster, and end one of this machine."""
        self.client.close(timeout=SECONDS_TO_CONNECT)
        if self._local is not None:
            self._local.close(timeout=SECONDS_TO_CONNECT)
