"""How a caller asks for workers, and for a part of the work: plain values, checked when they are made."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import TypeVar

T = TypeVar("T")

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
        several = (self.workers or cores()) > 1
        kind = "processes" if processes and several else "threads"
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

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


def shard_of(text: str | None) -> Shard | None:
    """The shard of a text such as ``2/8``, the second eighth; None of None. Raises ValueError for what is no shard."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)/(\d+)", str(text))
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"shard={text}; it must be i/n with i from 1 to n: shard=2/8")
    return Shard(int(match[1]), int(match[2]))
