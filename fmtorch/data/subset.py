"""Some of a data set's pairs, as a data set."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.pairs import DepthDataset, ImagePair, ImageSource, PairDataset


class PairSubset(PairDataset):
    """The pairs of these indices, in this order. `subset` keeps what the data set knows of depth."""

    def __init__(self, dataset: PairDataset, indices: Sequence[int]) -> None:
        self.dataset, self.indices = dataset, list(indices)
        self.name = dataset.name
        self.digest = hashlib.sha256(f"{dataset.digest} {self.indices}".encode()).hexdigest()

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> ImagePair:
        return self.dataset[self.indices[index]]


class _DepthSubset(PairSubset):
    dataset: DepthDataset

    def depth(self, image: ImageSource, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """As of the whole data set."""
        return self.dataset.depth(image, points)


def subset(dataset: PairDataset, indices: Sequence[int]) -> PairSubset:
    """Some pairs of a data set; all of them: the data set's digest still changes, as it names the pairs."""
    return _DepthSubset(dataset, indices) if isinstance(dataset, DepthDataset) else PairSubset(dataset, indices)
