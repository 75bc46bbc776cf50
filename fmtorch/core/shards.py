"""Shards of a list of work: ``2/8`` is the second eighth, for machines that know nothing of one another."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Shard:
    """The shard of this number, from 1 to `count`."""

    number: int
    count: int

    def of(self, items: Sequence[T]) -> Sequence[T]:
        """The shard's items, which follow one another; shards differ by one item at most."""
        total = len(items)
        return items[total * (self.number - 1) // self.count : total * self.number // self.count]

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


def shard_of(text: str | None) -> Shard | None:
    """The shard of a text such as ``2/8``; None of None. Raises ValueError for what is no shard."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)/(\d+)", str(text))
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"shard={text}; it must be i/n with i from 1 to n: shard=2/8")
    return Shard(int(match[1]), int(match[2]))
