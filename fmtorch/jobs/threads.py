"""How many threads a stage, a worker or a loop over pairs computes with."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")

_held: ContextVar[int] = ContextVar("_held", default=1)


@contextlib.contextmanager
def one_thread(device: torch.device | str) -> Iterator[None]:
    """Within it torch computes with one thread on the CPU; a GPU is left alone.

    For stages of many small operations. On a busy machine several threads wait for one another at the end of each: two
    matched 6,892 x 3,461 descriptors in 6 to 16 s where one needs 0.5 s, and estimated twenty times as slowly. What
    works pair by pair may still use the `available` threads.
    """
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
    The first error, in the items' order, is raised here once those under way have ended; the others are not begun.
    """
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
