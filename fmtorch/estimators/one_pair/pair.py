"""The usable matches of one pair as arrays, and their way back to a bucket of tensors."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.estimators.pairs import NormalizedPairs

Array = NDArray[Any]


@dataclasses.dataclass(frozen=True, eq=False)
class OnePair:
    """What `NormalizedPairs` holds of one pair, without mask and padding. Arrays are float64 and C-contiguous.

    points: (4, n), rows x0, y0, x1, y1 in normalised units. slots: of the pair's bucket, which decides how priors are
    quantised and whether there is a first look. quality, prior, noise: (n,), None where the caller has none. centre:
    (4,), of the points in pixels. sizes: (2, 2) of the images as (h, w), pixels, or None.
    """

    points: Array
    slots: int
    pixels_per_unit: float
    key: int
    seed: int
    quality: Array | None
    prior: Array | None
    noise: Array | None
    centre: Array
    sizes: Array | None = None
    kept: dict[Hashable, Any] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        """One: of pairs, not of matches."""
        return 1

    @property
    def count(self) -> int:
        """Number of matches."""
        return int(self.points.shape[1])

    @property
    def sizes_known(self) -> bool:
        """Whether the sizes of the images are known."""
        return self.sizes is not None

    @property
    def same_size(self) -> list[bool]:
        """As `NormalizedPairs.same_size`."""
        assert self.sizes is not None
        first, second = self.sizes.tolist()
        return [first == second]

    @functools.cached_property
    def points32(self) -> Array:
        """The points as scores take them, float32."""
        return self.points.astype(np.float32)

    @functools.cached_property
    def scale(self) -> Array:
        """Pixels in one normalised unit, divided by each match's noise, (n,)."""
        return self.pixels_per_unit / (np.ones(self.count) if self.noise is None else self.noise)

    @functools.cached_property
    def weight(self) -> Array:
        """What each match counts in a fit, (n,): its prior divided by the square of its noise."""
        prior = np.ones(self.count) if self.prior is None else self.prior
        return prior if self.noise is None else prior / np.square(self.noise)

    def once(self, name: Hashable, compute: Callable[[], Any]) -> Any:
        """What a part computes of all matches and needs again for the same pair."""
        if name not in self.kept:
            self.kept[name] = compute()
        return self.kept[name]

    def only(self, rows: Sequence[int]) -> OnePair:
        """As `NormalizedPairs.only`: itself."""
        return self

    def take(self, index: Array) -> OnePair:
        """The same pair with the matches of these indices."""

        def some(value: Array | None) -> Array | None:
            return None if value is None else value.take(index)

        return OnePair(
            self.points.take(index, 1), self.slots, self.pixels_per_unit, self.key, self.seed, some(self.quality),
            some(self.prior), some(self.noise), self.centre, self.sizes,
        )  # fmt: skip


def squared(value: float) -> float:
    """The square; infinite beyond the range of a float, as of tensors, where ``**`` of a Python float raises."""
    return value * value


def each_pair(pairs: NormalizedPairs) -> Iterator[OnePair]:
    """The pairs of a bucket one by one, copied, on no graph."""
    points = pairs.points.detach().numpy()
    quality, prior, noise = (_array(value) for value in (pairs.quality, pairs.prior, pairs.noise))
    centre, sizes = pairs.centre.numpy(), None
    if pairs.size0 is not None and pairs.size1 is not None:
        sizes = torch.stack([pairs.size0, pairs.size1], 1).to(torch.float64).numpy()
    table = zip(pairs.count.tolist(), pairs.pixels_per_unit.tolist(), pairs.key.tolist(), strict=True)
    for i, (n, unit, key) in enumerate(table):
        q, p, s = (None if value is None else value[i, :n].copy() for value in (quality, prior, noise))
        yield OnePair(
            np.ascontiguousarray(points[:, i, :n]), points.shape[2], unit, key, pairs.seed, q, p, s, centre[i],
            None if sizes is None else sizes[i],
        )  # fmt: skip


def _array(value: Tensor | None) -> Array | None:
    return None if value is None else value.detach().numpy()
