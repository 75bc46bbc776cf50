"""Which images are worth matching: those whose VLAD vectors are most alike."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.pipeline.folder_images import Pair
from fmtorch.pipeline.two_images import Described

ROWS = 1024  # of the matrix of similarities that exist at a time


def vectors_of(described: Iterable[Described | None], vector: Callable[[Tensor], Tensor]) -> Float[Tensor, "n d"]:
    """A vector for each image by its local descriptors; zeros where there is no image."""
    vectors = [None if each is None else vector(each.features.descriptors) for each in described]
    length = max((len(each) for each in vectors if each is not None), default=1)
    return torch.stack([torch.zeros(length) if each is None else each for each in vectors])


def similar_pairs(images: Sequence[Path], vectors: Float[Tensor, "n d"], count: int) -> list[Pair]:
    """Each image with its `count` most similar ones, by the inner products of the vectors; a pair once, in order.

    Images without a vector, zeros, are in no pair. Of equally similar ones those of lower number come first.
    """
    described = (vectors != 0).any(1)
    selected: set[tuple[int, int]] = set()
    for start in range(0, len(vectors), ROWS):
        similarity = vectors[start : start + ROWS] @ vectors.T
        similarity[:, ~described] = -torch.inf
        rows = torch.arange(len(similarity))
        similarity[rows, rows + start] = -torch.inf
        values, order = similarity.sort(dim=1, descending=True, stable=True)
        for row, (best, neighbors) in enumerate(zip(values[:, :count], order[:, :count], strict=True), start=start):
            if described[row]:
                selected |= {(min(row, j), max(row, j)) for j in neighbors[best > -torch.inf].tolist()}
    return [(images[i], images[j]) for i, j in sorted(selected)]
