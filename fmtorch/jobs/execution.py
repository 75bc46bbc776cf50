"""How many threads a stage, a worker or a loop over pairs computes with, and how a caller asks for workers."""

import contextlib
import dataclasses
import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")

KINDS = ("auto", "threads", "processes", "dask")
MIN_PAIRS_FOR_PROCESSES = 1000  # of given matches, start included: 10.0 s by one thread, 8.4 by two processes


def cores() -> int:
    """How many processor cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclasses.dataclass(frozen=True)
class Execution:
    """Where work is done.
    kind: one of `KINDS`; of "auto" the caller makes one of the others. workers: how many; None: one a core, those of
    the cluster, or as many as `make` has. address: of a scheduler of Dask; None: a cluster on this machine.
    send_images: whether images go to the workers as bytes. make: anybody's executor, in place of a kind."""

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
        return self.make is None and self.kind == "threads"

    def decided(self, processes: bool) -> "Execution":
        """The same with "auto" as processes, or as threads: one worker is a thread in any case."""
        kind = "processes" if processes and (self.workers or cores()) > 1 else "threads"
        return self if self.kind != "auto" else dataclasses.replace(self, kind=kind)


@dataclasses.dataclass(frozen=True)
class Shard:
    """Part `number` (from 1) of `count` of a list of work, for machines that know nothing of one another."""

    number: int
    count: int

    def of(self, items: Sequence[T]) -> Sequence[T]:
        """The shard's items, which follow one another; shards differ by one item at most."""
        total = len(items)
        return items[total * (self.number - 1) // self.count : total * self.number // self.count]


def shard_of(text: str | None) -> Shard | None:
    """The shard of a text such as ``2/8``, the second eighth; None of None. Raises ValueError for what is no shard."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)/(\d+)", str(text))
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"shard={text}; it must be i/n with i from 1 to n: shard=2/8")
    return Shard(int(match[1]), int(match[2]))


_held: ContextVar[int] = ContextVar("_held", default=1)


@contextlib.contextmanager
def one_thread(device: torch.device | str) -> Iterator[None]:
    """Within it torch computes with one thread on the CPU; a GPU is left alone.
    For stages of many small operations. On a busy machine several threads wait for one another at the end of each: two
    matched 6,892 x 3,461 descriptors in 6 to 16 s where one needs 0.5 s, and estimated twenty times as slowly. What
    works pair by pair may still use the `available` threads."""
    before = torch.get_num_threads()
    if torch.device(device).type != "cpu" or before == 1:
        yield
        return
    with _threads(1, before):
        yield


@contextlib.contextmanager
def _threads(count: int, held_by_pairs: int) -> Iterator[None]:
    """Within it torch computes with so many threads, and what works pair by pair may use so many."""
    before = torch.get_num_threads()
    held = _held.set(held_by_pairs)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _held.reset(held)


def use_one_thread() -> None:
    """Have torch and OpenCV compute with one thread from now on: for workers, of which there is one a core."""
    import cv2

    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def available() -> int:
    """The threads that torch may use, within `one_thread` those that it might before."""
    return max(_held.get(), torch.get_num_threads())


def mapped(function: Callable[[T], R], items: Sequence[T], *, share: bool = False) -> list[R]:
    """The function of each item, in their order, by as many threads as are `available`.
    For functions that leave Python's lock to others most of the time, as compiled ones do. They run as in this thread
    as far as gradients go, and with one thread of torch's own; with share=True torch's threads are shared out evenly.
    The first error, in the items' order, is raised here once those under way have ended; the others are not begun."""
    threads = min(available(), len(items))
    own = available() // threads if share and threads else 1
    if threads < 2:
        return [function(item) for item in items]
    graphs = torch.is_grad_enabled()

    def run(item: T) -> R:
        with torch.set_grad_enabled(graphs), _threads(own, own):
            return function(item)

    with ThreadPoolExecutor(threads) as pool:
        results = [pool.submit(run, item) for item in items]
        try:
            return [result.result() for result in results]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
