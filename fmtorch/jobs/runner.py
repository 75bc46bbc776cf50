"""Many tasks by a pool of workers: results as they come, and the tasks of workers that died done again.

What all tasks need is shared by threads (`Local`) or made once in each process (`Factory`). A worker of a cluster, or
of anybody's executor, has no start of its own in which to make it: each task names it by its digest, and where that
says nothing to the worker, the task is sent again with how to make it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from typing import Any, Generic, TypeVar

from fmtorch.core.version import __version__
from fmtorch.jobs.pool import WorkerPool, WorkersLost
from fmtorch.jobs.threads import use_one_thread

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


class VersionError(ValueError):
    """Workers of another version of fmtorch, whose results would differ."""


_values: OrderedDict[str, Any] = OrderedDict()
_lock = threading.Lock()


def _called(digest: str, factory: bytes | None, function: Callable[[Any, Any], Any], task: Any) -> Any:
    with _lock:
        if digest not in _values:
            if factory is None:
                return NeedsFactory()
            _values[digest] = _made(factory)
        _values.move_to_end(digest)
        while len(_values) > KEPT:
            _values.popitem(last=False)
        value = _values[digest]
    return function(value, task)


def _made(factory: bytes) -> Any:
    """What a factory makes, in a process whose workers compute with a thread each: contended ones collapse."""
    use_one_thread()
    version, make = pickle.loads(factory)
    if version != __version__:
        raise VersionError(f"a worker has fmtorch {__version__}, the command {version}; install the same on both")
    return make()


class TaskRunner(Generic[Task]):
    """Calls ``function(value, task)`` for each task, several at a time.

    Where a worker dies, the tasks that may have been its are done again, one at a time, so that the one that ends its
    worker is known: it is taken apart by `split`, and what ends its worker `MAX_DEATHS` times is told to `give_up`.

    Args:
        pool: who works; it stays open. source: of `value`. function: known by its module and name.
        keep: called here with a task and its result. give_up: called with a task and the reason; None: WorkersLost is
            raised. split: a task as several smaller ones; one alone where it is as small as can be.
    """

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
        Interrupted, it waits for what is under way and keeps it. What a task raises is raised here. Raises WorkersLost
        where the scheduler is gone, or workers die whatever they do.
        """
        todo = iter(tasks)
        try:
            while True:
                for task in todo:
                    if task is None:
                        break
                    self._submit(task)
                    if len(self.waiting) >= self.pool.ahead:
                        break
                if not self.waiting:
                    break
                finished, _ = wait(self.waiting, return_when=FIRST_COMPLETED)
                yield from self._finished(finished)
        finally:
            self._end()

    def begin(self, task: Task) -> Future[Any]:
        """Have a task begun before those of `each`, which yields it."""
        return self._submit(task)

    def _submit(self, task: Task, with_factory: bool = False) -> Future[Any]:
        call = self.source.call(self.function, with_factory)
        try:
            future: Future[Any] = self.pool.executor.submit(call, task)
        except BrokenExecutor:  # since the last result
            future = Future()
            future.set_exception(BrokenExecutor())
        except Exception as error:
            if (lost := self.pool.lost(error)) is not None:
                raise lost from error
            raise
        self.waiting[future] = task
        return future

    def _finished(self, futures: Iterable[Future[Any]]) -> Iterator[Task]:
        suspects: list[Task] = []
        broken = False
        for future in futures:
            task = self.waiting.pop(future)
            try:
                if self._done(task, future.result()):
                    yield task
            except (Exception, CancelledError) as error:
                if not self._is_death(error):
                    raise
                broken = broken or isinstance(error, BrokenExecutor)
                suspects.append(task)
        if broken:  # all that is under way ends, with a result or for the same reason
            finished, _ = wait(self.waiting)
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
        """Keep a result; False where the worker first needs the factory, with which the task is sent again."""
        if isinstance(result, NeedsFactory):
            self._submit(task, with_factory=True)
            return False
        self._succeeded = True
        self.keep(task, result)
        return True

    def _alone(self, task: Task, suspects: list[Task]) -> Iterator[Task]:
        """A task with no other under way, so that a worker that dies is its doing."""
        parts = [task] if self.split is None else self.split(task)
        for _ in range(MAX_DEATHS if len(parts) == 1 else 1):
            future = self._submit(task, with_factory=True)
            try:
                result = future.result()
            except (Exception, CancelledError) as error:
                if not self._is_death(error):
                    raise
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
            if not self._is_death(error):
                raise
            self.pool.renew()
            return False
        return True

    def _is_death(self, error: BaseException) -> bool:
        if any(cls.__name__ in _DEATHS for cls in type(error).__mro__) or isinstance(error, BrokenExecutor):
            return True
        if (lost := self.pool.lost(error)) is not None:
            raise lost from error
        return False

    def _end(self) -> None:
        """Wait for what is under way, and keep it; what has not begun is dropped."""
        for future in self.waiting:
            future.cancel()
        wait(self.waiting)
        for future, task in self.waiting.items():
            if not future.cancelled() and future.exception() is None:
                result = future.result()
                if not isinstance(result, NeedsFactory):
                    self.keep(task, result)
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
