"""The usable matches of one pair as arrays, and their way back to a bucket of tensors."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.estimators.pairs import NormalizedPairs

Array = NDArray[Any]


class OnePair:
    """What `NormalizedPairs` holds of one pair, without mask and padding. Arrays are float64 and C-contiguous.

    table: (9, n), a row each of x0, y0, x1, y1 in normalised units, weight, scale, prior, noise, quality. points: the
    first four. weight: what each match counts in a fit, its prior divided by the square of its noise. scale: pixels in
    one normalised unit, divided by the noise. support: the prior, ones where the caller has none; prior, noise,
    quality: None then. told: which of these three there are. slots: of the pair's bucket, which decides how priors are
    quantised and whether there is a first look. centre: (4,), of the points in pixels. sizes: (4,), of the images as
    h, w, h, w, pixels, empty where unknown. kept: by `once`. shared: what is true of the pair with any of its matches.
    """

    def __init__(
        self, table: Array, told: tuple[bool, bool, bool], slots: int, pixels_per_unit: float, key: int, seed: int,
        centre: Array, sizes: Array, shared: dict[Hashable, Any] | None = None,
    ) -> None:  # fmt: skip
        self.table, self.told, self.slots, self.pixels_per_unit = table, told, slots, pixels_per_unit
        self.key, self.seed, self.centre, self.sizes = key, seed, centre, sizes
        self.count = table.shape[1]
        self.points, self.weight, self.scale, self.support = table[:4], table[4], table[5], table[6]
        self.prior: Array | None = self.support if told[0] else None
        self.noise: Array | None = table[7] if told[1] else None
        self.quality: Array | None = table[8] if told[2] else None
        self.kept: dict[Hashable, Any] = {}
        self.shared: dict[Hashable, Any] = {} if shared is None else shared

    def __len__(self) -> int:
        """One: of pairs, not of matches."""
        return 1

    @property
    def sizes_known(self) -> bool:
        """Whether the sizes of the images are known."""
        return len(self.sizes) > 0

    @property
    def same_size(self) -> list[bool]:
        """As `NormalizedPairs.same_size`."""
        h0, w0, h1, w1 = self.sizes.tolist()
        return [h0 == h1 and w0 == w1]

    @property
    def points32(self) -> Array:
        """The points as scores take them, float32."""
        points: Array = self.once("points32", _points32)
        return points

    def once(self, name: Hashable, compute: Callable[[OnePair], Any]) -> Any:
        """What a part computes of all these matches, and needs again."""
        found = self.kept.get(name)
        if found is None:
            found = self.kept[name] = compute(self)
        return found

    def only(self, rows: Sequence[int]) -> OnePair:
        """As `NormalizedPairs.only`: itself."""
        return self

    def take(self, index: Array) -> OnePair:
        """The same pair with the matches of these indices."""
        return OnePair(
            self.table.take(index, 1), self.told, self.slots, self.pixels_per_unit, self.key, self.seed, self.centre,
            self.sizes, self.shared,
        )  # fmt: skip


def _points32(pair: OnePair) -> Array:
    return pair.points.astype(np.float32)


def squared(value: float) -> float:
    """The square; infinite beyond the range of a float, as of tensors, where ``**`` of a Python float raises."""
    return value * value


def each_pair(pairs: NormalizedPairs) -> Iterator[OnePair]:
    """The pairs of a bucket one by one, copied, on no graph."""
    optional = (pairs.prior, pairs.noise, pairs.quality)
    told = pairs.prior is not None, pairs.noise is not None, pairs.quality is not None
    values = [torch.ones_like(pairs.mask, dtype=torch.float64) if value is None else value for value in optional]
    scale = pairs.scale.expand_as(pairs.mask)
    rows = torch.stack([*pairs.points, pairs.weight, scale, *values]).detach().numpy()
    centre, sizes = pairs.centre.numpy(), np.empty((len(pairs), 4 if pairs.sizes_known else 0))
    if pairs.size0 is not None and pairs.size1 is not None:
        sizes[:, :2], sizes[:, 2:] = pairs.size0.numpy(), pairs.size1.numpy()
    table = zip(pairs.count.tolist(), pairs.pixels_per_unit.tolist(), pairs.key.tolist(), strict=True)
    for i, (n, unit, key) in enumerate(table):
        yield OnePair(
            np.ascontiguousarray(rows[:, i, :n]), told, rows.shape[2], unit, key, pairs.seed, centre[i], sizes[i]
        )
