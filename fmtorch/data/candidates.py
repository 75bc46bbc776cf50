"""Which pairs of a scene's images are worth a look: of a video those a second apart, of a collection all, or those
that see the same points of its reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

Indices = NDArray[np.int64]

WINDOW = 1.0  # s: a frame is paired with those of the following second (Bian et al., BMVC 2019, Section 3)
MIN_SHARED = 1  # points of a reconstruction that two images must both see
_ROUNDING = 1e-6  # s, of time stamps in text files
_AT_ONCE = 512  # images whose shared points are counted together


@runtime_checkable
class Candidates(Protocol):
    """Pairs (i, j), i < j, of a scene's images in a fixed order; not necessarily all in memory."""

    def __len__(self) -> int: ...

    def at(self, ranks: Indices) -> Indices:
        """The pairs (n, 2) at these places (n,) of the order."""
        ...


class AllPairs:
    """All pairs of n images, in the order (0, 1), (0, 2), ..., (1, 2), ..."""

    def __init__(self, n: int) -> None:
        self.n = n
        self._starts = np.cumsum([0, *range(n - 1, 0, -1)])  # where the pairs that begin with image i begin

    def __len__(self) -> int:
        return self.n * (self.n - 1) // 2

    def at(self, ranks: Indices) -> Indices:
        """The pairs (n, 2) at these places (n,)."""
        first = np.searchsorted(self._starts, ranks, side="right") - 1
        return np.stack([first, first + 1 + ranks - self._starts[first]], -1)


class ListedPairs:
    """Pairs (n, 2) that are listed."""

    def __init__(self, pairs: Indices) -> None:
        self.pairs = pairs.reshape(-1, 2)

    def __len__(self) -> int:
        return len(self.pairs)

    def at(self, ranks: Indices) -> Indices:
        """The pairs (n, 2) at these places (n,)."""
        return self.pairs[ranks]


def following(times: Sequence[float] | NDArray[np.float64], window: int | float = WINDOW) -> ListedPairs:
    """Each frame with those at most `window` seconds later; times (n,) in seconds, ascending."""
    t = np.asarray(times, dtype=np.float64)
    ends = np.searchsorted(t, t + window + _ROUNDING, side="right")
    counts = ends - np.arange(len(t)) - 1
    first = np.repeat(np.arange(len(t)), counts)
    within = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    return ListedPairs(np.stack([first, first + 1 + within], -1).astype(np.int64))


def sharing_points(points: Sequence[NDArray[np.int64]], minimum: int = MIN_SHARED) -> ListedPairs:
    """The pairs of images that both see at least `minimum` points; points: of each image the numbers it sees.

    Memory is that of the pairs found; a reconstruction of n images with a mean track of m images has, in all, about
    m / 2 such pairs for each point, most of them the same ones over and over.
    """
    sees = incidence(points)
    blocks = []
    for begin in range(0, len(points), _AT_ONCE):
        shared = (sees[begin : begin + _AT_ONCE] @ sees.T).tocoo()
        first, second = shared.row.astype(np.int64) + begin, shared.col.astype(np.int64)
        kept = (shared.data >= minimum) & (first < second)
        pairs = np.stack([first[kept], second[kept]], -1)
        blocks.append(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])
    return ListedPairs(np.concatenate([*blocks, np.zeros((0, 2), np.int64)]))


def incidence(points: Sequence[Indices]) -> scipy.sparse.csr_array:
    """Which image sees which point, (images, points) of ones; points: of each image the numbers it sees."""
    seen = [np.unique(p) for p in points]
    _, columns = np.unique(np.concatenate([*seen, np.zeros(0, np.int64)]), return_inverse=True)
    return scipy.sparse.csr_array(
        (np.ones(len(columns), np.int32), columns.astype(np.int64), np.cumsum([0, *map(len, seen)])),
        shape=(len(seen), int(columns.max(initial=-1)) + 1),
    )


def drawn(total: int, count: int | None, seed: int) -> Sequence[int] | Indices:
    """Places of `count` of `total` pairs, drawn at random by the seed and sorted; all where there are no more."""
    if count is None or count >= total:
        return range(total)
    return np.sort(np.random.default_rng(seed).choice(total, count, replace=False))
