"""Many calls by a team of workers: results as they come, and calls of workers that died made again."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from typing import Any, Generic, TypeVar

from fmtorch.core.executors import Team, WorkersLost
from fmtorch.core.recipes import NotMade, Source

Job = TypeVar("Job")
MAX_DEATHS = 3  # of workers that a call has to itself
_DEATHS = ("KilledWorker", "CommClosedError")  # of dask, by name: nobody else needs to have it
DEATH = f"the worker process died {MAX_DEATHS} times, perhaps for want of memory"


class Calls(Generic[Job]):
    """Calls ``function(value, job)`` for each job, several at a time.

    Where a worker dies, the calls that may have been its are made again, one at a time, so that the one that ends its
    worker is known: it is taken apart by `split`, and what ends its worker `MAX_DEATHS` times is told to `give_up`.

    Args:
        team: who works. source: of `value`, which workers share or make. function: known by its module and name.
        keep: called here with a job and its result. give_up: called with a job and the reason; None: WorkersLost is
            raised. split: a job as several smaller ones; one alone where it is as small as can be.
    """

    def __init__(
        self, team: Team, source: Source[Any], function: Callable[[Any, Job], Any], keep: Callable[[Job, Any], None],
        give_up: Callable[[Job, str], None] | None = None, split: Callable[[Job], list[Job]] | None = None,
    ) -> None:  # fmt: skip
        self.team, self.source, self.function = team, source, function
        self.keep, self.give_up, self.split = keep, give_up, split
        self.waiting: dict[Future[Any], Job] = {}
        self._succeeded = False

    def each(self, jobs: Iterable[Job]) -> Generator[Job, None, None]:
        """Have the jobs done, and yield each once its result is kept.

        Interrupted, it waits for what is under way and keeps it. What a call raises is raised here. Raises WorkersLost
        where the scheduler is gone, or workers die whatever they do.
        """
        todo = iter(jobs)
        try:
            while True:
                for job in todo:
                    self._submit(job)
                    if len(self.waiting) >= self.team.ahead:
                        break
                if not self.waiting:
                    break
                finished, _ = wait(self.waiting, return_when=FIRST_COMPLETED)
                yield from self._finished(finished)
        finally:
            self._end()

    def begin(self, job: Job) -> Future[Any]:
        """Have a job begun before those of `each`, which yields it."""
        return self._submit(job)

    def _submit(self, job: Job, with_recipe: bool = False) -> Future[Any]:
        call = self.source.call(self.function, with_recipe)
        try:
            future: Future[Any] = self.team.executor.submit(call, job)
        except BrokenExecutor:  # since the last result
            future = Future()
            future.set_exception(BrokenExecutor())
        except Exception as error:
            if (lost := self.team.lost(error)) is not None:
                raise lost from error
            raise
        self.waiting[future] = job
        return future

    def _finished(self, futures: Iterable[Future[Any]]) -> Iterator[Job]:
        suspects: list[Job] = []
        broken = False
        for future in futures:
            job = self.waiting.pop(future)
            try:
                if self._done(job, future.result()):
                    yield job
            except (Exception, CancelledError) as error:
                if not self._is_death(error):
                    raise
                broken = broken or isinstance(error, BrokenExecutor)
                suspects.append(job)
        if broken:  # all that is under way ends, with a result or for the same reason
            finished, _ = wait(self.waiting)
            for future in finished:
                job = self.waiting.pop(future)
                if future.cancelled() or future.exception() is not None:
                    suspects.append(job)
                elif self._done(job, future.result()):
                    yield job
            self.team.renew()
        while suspects:
            yield from self._alone(suspects.pop(0), suspects)

    def _done(self, job: Job, result: Any) -> bool:
        """Keep a result; False where the worker first needs the recipe, with which the call is made again."""
        if isinstance(result, NotMade):
            self._submit(job, with_recipe=True)
            return False
        self._succeeded = True
        self.keep(job, result)
        return True

    def _alone(self, job: Job, suspects: list[Job]) -> Iterator[Job]:
        """A job with no other under way, so that a worker that dies is its doing."""
        parts = [job] if self.split is None else self.split(job)
        for _ in range(MAX_DEATHS if len(parts) == 1 else 1):
            future = self._submit(job, with_recipe=True)
            try:
                result = future.result()
            except (Exception, CancelledError) as error:
                if not self._is_death(error):
                    raise
                self.team.renew()
            else:
                if self._done(job, result):
                    yield job
                return
            finally:
                self.waiting.pop(future, None)
        if len(parts) > 1:
            suspects[:0] = parts
            return
        if self.give_up is None or not (self._succeeded or self._can_begin()):
            raise WorkersLost(_LOST)
        self.give_up(job, DEATH)
        yield job

    def _can_begin(self) -> bool:
        """Whether a worker lives that has only what all calls need."""
        try:
            self.team.executor.submit(self.source.call(_nothing, True), None).result()
        except (Exception, CancelledError) as error:
            if not self._is_death(error):
                raise
            self.team.renew()
            return False
        return True

    def _is_death(self, error: BaseException) -> bool:
        if any(cls.__name__ in _DEATHS for cls in type(error).__mro__) or isinstance(error, BrokenExecutor):
            return True
        if (lost := self.team.lost(error)) is not None:
            raise lost from error
        return False

    def _end(self) -> None:
        """Wait for what is under way, and keep it; what has not begun is dropped."""
        for future in self.waiting:
            future.cancel()
        self.team.close()
        for future, job in self.waiting.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                result = future.result()
                if not isinstance(result, NotMade):
                    self.keep(job, result)


def _nothing(value: object, job: object) -> None:
    """A call that only makes what calls need."""


_LOST = (
    "worker processes die whatever they do, perhaps for want of memory: the same command goes on from here; fewer "
    "workers, or executor=threads, need less of it"
)
