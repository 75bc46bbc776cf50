"""Many tasks by a pool of workers: threads, processes, a cluster of Dask, or any executor of `concurrent.futures`.

What all tasks need is shared by threads (`Local`) or made once in each process (`Factory`). A worker of a cluster, or
of anybody's executor, has no start of its own in which to make it: each task names it by its digest, and where that
says nothing to the worker, the task is sent again with how to make it."""

import contextlib
import functools
import hashlib
import multiprocessing.connection
import os
import pickle
import signal
import sys
import threading
import time
import types
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from typing import Any, Generic, TypeVar, cast

import torch

from fmtorch.core import lazy
from fmtorch.core.version import __version__
from fmtorch.jobs.execution import Execution, cores, use_one_thread

MAX_PROCESSES = 8  # unless more are asked for: each may hold networks and some 0.5 GB
SHARED_BY = "file_system"  # tensors between processes: 1,225 pairs of a folder in 22 s, by file descriptors in 27
SECONDS_TO_CONNECT = 10.0
SECONDS_FOR_WORKERS = 60.0
SECONDS_BETWEEN_COUNTS = 2.0
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class WorkersLost(ConnectionError):
    """Workers, or the scheduler, that are there no more; what was stored is kept."""


class WorkerPool(contextlib.AbstractContextManager["WorkerPool"]):
    """The workers of an `Execution`, started at their first task, and replaced where they broke; a context manager.
    execution: which workers. preload: modules that processes import before they are forked. limit: workers at most.
    needs_main: whether tasks may be of the caller's main module, which processes then import."""

    def __init__(
        self, execution: Execution, preload: Sequence[str] = (__name__,), limit: int | None = None,
        needs_main: bool = True,
    ) -> None:  # fmt: skip
        self.execution, self.preload, self.needs_main = execution, preload, needs_main
        count = execution.workers or (min(cores(), MAX_PROCESSES) if execution.kind == "processes" else cores())
        self.size = max(1, count if limit is None else min(count, limit))
        self._executor: Executor | None = None
        self._cluster: _Cluster | None = None

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def executor(self) -> Executor:
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
        if self._cluster is not None:
            self._cluster.close()
        elif self._executor is not None:
            self._executor.shutdown(wait=True)
        self._executor = self._cluster = None

    def expect_scheduler(self, error: BaseException) -> None:
        """Raises WorkersLost where an error means that the scheduler is gone."""
        if self._cluster is not None and self._cluster.lost(error):
            lost = f"the scheduler at {self._cluster.address} was lost"
            raise WorkersLost(f"{lost}; with another, the same command goes on from here") from error

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
        return self._processes() if execution.kind == "processes" else futures.ThreadPoolExecutor(self.size)

    def _processes(self) -> Executor:
        """Forked of a process that has no threads, where there is fork; each has the environment of this one."""
        spawned = "forkserver" not in multiprocessing.get_all_start_methods() or sys.platform == "darwin"
        context = multiprocessing.get_context("spawn" if spawned else "forkserver")
        if not spawned:
            context.set_forkserver_preload(list(self.preload))
        pool = futures.ProcessPoolExecutor if self.needs_main else _WithoutMain
        return pool(self.size, context, initializer=_begin, initargs=({**os.environ, **_ONE_THREAD},))


class _WithoutMain(futures.ProcessPoolExecutor):
    """Processes that do not import this one's main module: they start within `submit`, as if it were empty."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
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
    Raises ImportError without Dask, and ValueError where nobody answers at the address or no worker comes."""

    def __init__(self, address: str | None, workers: int) -> None:
        needed = "executor=dask needs dask and distributed: pip install 'fmtorch[dask]'"
        distributed = lazy.imported("distributed", needed)
        self._local: Any = None
        if address is None:
            # What workers log of a worker that died, and of their own end, is ours to say.
            options = {"dashboard_address": None, "silence_logs": 50, "protocol": "tcp"}
            self._local = distributed.LocalCluster(workers, threads_per_worker=1, **options)
        try:
            self.client = distributed.Client(self._local or address, timeout=SECONDS_TO_CONNECT, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            remedy = "start one by `dask scheduler`, or leave the address out for a cluster on this machine"
            raise ValueError(f"executor.address={address}: no scheduler answers; {remedy}") from error
        self.address = str(address or self._local.scheduler_address)
        try:
            self.client.wait_for_workers(1, timeout=SECONDS_FOR_WORKERS)
        except TimeoutError as error:
            self.close()
            remedy = f"start some by `dask worker {address}`"
            raise ValueError(f"executor.address={address}: the scheduler has no workers; {remedy}") from error
        self.executor = cast(Executor, self.client.get_executor(pure=False))
        self._threads, self._counted = 1, 0.0

    def threads(self) -> int:
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
        self.client.close(timeout=SECONDS_TO_CONNECT)
        if self._local is not None:
            self._local.close(timeout=SECONDS_TO_CONNECT)


T = TypeVar("T")
Task = TypeVar("Task")
MAX_DEATHS = 3  # of workers that a task has to itself
DEATH = f"the worker process died {MAX_DEATHS} times, perhaps for want of memory"
KEPT = 4  # things made in a process that stay there
SENT_ALONG = 50_000  # bytes of a factory that go with each task
_DEATHS = ("KilledWorker", "CommClosedError")  # of Dask, by name: nobody else needs to have it
_LOST = (
    "worker processes die whatever they do, perhaps for want of memory: the same command goes on from here; fewer "
    "workers, or executor=threads, need less of it"
)


class Local(Generic[T]):
    """A value that workers of this process share; pickled along with each task where they are of another one."""

    shared = True

    def __init__(self, value: T) -> None:
        self.value = value

    def call(self, function: Callable[[T, Any], Any], with_factory: bool) -> Callable[[Any], Any]:
        """The function with the value as its first argument."""
        return functools.partial(function, self.value)


class Factory(Generic[T]):
    """How other processes make a value: `make`, which is pickled."""

    shared = False

    def __init__(self, make: Callable[[], T]) -> None:
        self.pickled = pickle.dumps((__version__, make))
        self.digest = hashlib.blake2b(self.pickled, digest_size=16).hexdigest()

    def call(self, function: Callable[[T, Any], Any], with_factory: bool) -> Callable[[Any], Any]:
        """The function with the value as its first argument. with_factory: this is sent along, however long it is."""
        sent = self.pickled if with_factory or len(self.pickled) <= SENT_ALONG else None
        return functools.partial(_called, self.digest, sent, function)


Source = Local[T] | Factory[T]


class NeedsFactory:
    """The answer of a worker that does not have the factory."""


_values: OrderedDict[str, Any] = OrderedDict()
_lock = threading.Lock()


def _called(digest: str, factory: bytes | None, function: Callable[[Any, Any], Any], task: Any) -> Any:
    with _lock:
        if digest not in _values:
            if factory is None:
                return NeedsFactory()
            use_one_thread()  # as many workers compute: contended threads collapse
            version, make = pickle.loads(factory)
            if version != __version__:
                both = f"a worker has fmtorch {__version__}, the command {version}"
                raise ValueError(f"{both}; install the same on both")  # results would differ
            _values[digest] = make()
        _values.move_to_end(digest)
        while len(_values) > KEPT:
            _values.popitem(last=False)
        value = _values[digest]
    return function(value, task)


class TaskRunner(Generic[Task]):
    """Calls ``function(value, task)`` for each task, several at a time.
    Where a worker dies, the tasks that may have been its are done again, one at a time, so that the one that ends its
    worker is known: it is taken apart by `split`, and what ends its worker `MAX_DEATHS` times is told to `give_up`.
    pool: who works; it stays open. source: of `value`. function: known by its module and name. keep: called here with a
    task and its result. give_up: called with a task and the reason; None: WorkersLost is raised. split: a task as
    several smaller ones; one alone where it is as small as can be."""

    def __init__(
        self, pool: WorkerPool, source: Source[Any], function: Callable[[Any, Task], Any],
        keep: Callable[[Task, Any], None], give_up: Callable[[Task, str], None] | None = None,
        split: Callable[[Task], list[Task]] | None = None,
    ) -> None:  # fmt: skip
        self.pool, self.source, self.function = pool, source, function
        self.keep, self.give_up, self.split = keep, give_up, split
        self.waiting: dict[Future[Any], Task] = {}
        self._succeeded = False

    def each(self, tasks: Iterable[Task | None]) -> Generator[Task, None, None]:
        """Have the tasks done, and yield each once its result is kept.
        tasks: taken as workers become free; a None says that none can begin before one under way has ended.
        Interrupted, it waits for what is under way and keeps it. Raises what tasks do; WorkersLost where none work."""
        todo = iter(tasks)
        try:
            while True:
                for task in todo:
                    if task is None:
                        break
                    self.begin(task)
                    if len(self.waiting) >= self.pool.ahead:
                        break
                if not self.waiting:
                    break
                finished, _ = futures.wait(self.waiting, return_when=futures.FIRST_COMPLETED)
                yield from self._finished(finished)
        finally:
            self._end()

    def begin(self, task: Task, with_factory: bool = False) -> Future[Any]:
        """Have a task begun before those of `each`, which yields it; with_factory: see `Factory.call`."""
        call = self.source.call(self.function, with_factory)
        try:
            future: Future[Any] = self.pool.executor.submit(call, task)
        except BrokenExecutor:  # since the last result
            future = Future()
            future.set_exception(BrokenExecutor())
        except Exception as error:
            self.pool.expect_scheduler(error)
            raise
        self.waiting[future] = task
        return future

    def _finished(self, ended: Iterable[Future[Any]]) -> Iterator[Task]:
        suspects: list[Task] = []
        broken = False
        for future in ended:
            task = self.waiting.pop(future)
            try:
                if self._done(task, future.result()):
                    yield task
            except (Exception, CancelledError) as error:
                self._expect_death(error)
                broken = broken or isinstance(error, BrokenExecutor)
                suspects.append(task)
        if broken:  # all that is under way ends, with a result or for the same reason
            finished, _ = futures.wait(self.waiting)
            for future in finished:
                task = self.waiting.pop(future)
                if future.cancelled() or future.exception() is not None:
                    suspects.append(task)
                elif self._done(task, future.result()):
                    yield task
            self.pool.renew()
        while suspects:
            yield from self._alone(suspects.pop(0), suspects)

    def _done(self, task: Task, result: Any) -> bool:
        if isinstance(result, NeedsFactory):
            self.begin(task, with_factory=True)
            return False
        self._succeeded = True
        self.keep(task, result)
        return True

    def _alone(self, task: Task, suspects: list[Task]) -> Iterator[Task]:
        """A task with no other under way, so that a worker that dies is its doing."""
        parts = [task] if self.split is None else self.split(task)
        for _ in range(MAX_DEATHS if len(parts) == 1 else 1):
            future = self.begin(task, with_factory=True)
            try:
                result = future.result()
            except (Exception, CancelledError) as error:
                self._expect_death(error)
                self.pool.renew()
            else:
                if self._done(task, result):
                    yield task
                return
            finally:
                self.waiting.pop(future, None)
        if len(parts) > 1:
            suspects[:0] = parts
            return
        if self.give_up is None or not (self._succeeded or self._can_begin()):
            raise WorkersLost(_LOST)
        self.give_up(task, DEATH)
        yield task

    def _can_begin(self) -> bool:
        """Whether a worker lives that has only what all tasks need."""
        try:
            self.pool.executor.submit(self.source.call(_nothing, True), None).result()
        except (Exception, CancelledError) as error:
            self._expect_death(error)
            self.pool.renew()
            return False
        return True

    def _expect_death(self, error: BaseException) -> None:
        """Raise an error that is not the death of a worker; WorkersLost where the scheduler is gone."""
        if not (isinstance(error, BrokenExecutor) or any(cls.__name__ in _DEATHS for cls in type(error).__mro__)):
            self.pool.expect_scheduler(error)
            raise error

    def _end(self) -> None:
        """Wait for what is under way, and keep it; what has not begun is dropped."""
        for future in self.waiting:
            future.cancel()
        futures.wait([future for future in self.waiting if not future.cancelled()])  # no lost scheduler tells
        for future, task in self.waiting.items():
            done = not future.cancelled() and future.exception() is None
            if done and not isinstance(future.result(), NeedsFactory):
                self.keep(task, future.result())
        self.waiting.clear()


def _nothing(value: object, task: object) -> None:
    """A task that only makes what tasks need."""


def in_order(
    pool: WorkerPool, source: Source[Any], function: Callable[[Any, Task], Any], tasks: Iterable[Task]
) -> Generator[tuple[Task, Any], None, None]:
    """The tasks, in their order, each with `function(value, task)`; see `TaskRunner`."""
    results: dict[int, tuple[Task, Any]] = {}

    def keep(numbered: tuple[int, Task], result: Any) -> None:
        results[numbered[0]] = numbered[1], result

    runner = TaskRunner(pool, source, functools.partial(_unnumbered, function), keep)
    following = 0
    with contextlib.closing(runner.each(enumerate(tasks))) as done:
        for _ in done:
            while following in results:
                yield results.pop(following)
                following += 1


def _unnumbered(function: Callable[[Any, Task], Any], value: Any, numbered: tuple[int, Task]) -> Any:
    return function(value, numbered[1])
