"""The matches of pairs of photographs, of which GeoDesc's batches consist (Luo et al., ECCV 2018, section 3.4).

The patches that a loss compares with each other then come from one pair of photographs, as when a descriptor is used;
pairs whose photographs are nearly alike are left out, since they teach little.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor, from_numpy

from fmtorch.training.track_geometry import patch_similarity

MAX_SIMILARITY = 0.85
"""Of the photographs of a pair: the paper leaves out those that are more alike."""


class Tracks(NamedTuple):
    """Patches of points, sorted by point.

    first: (n + 1,) where each point's patches begin. view: (m,) the photograph of each patch. rays: (m, 3) unit
    directions from the surface to its camera, in the world. incidence: (m,) degrees between ray and surface normal.
    """

    first: NDArray[np.int64]
    view: NDArray[np.int64]
    rays: NDArray[np.float32]
    incidence: NDArray[np.float32]


@dataclasses.dataclass(frozen=True, eq=False)
class MatchSets:
    """The matches of pairs of photographs, set after set.

    patches: (2, k) indices of the two patches of each match. similarity: (k,) its S_patch. first: (s + 1,) where each
    set begins. image_similarity: (s,) the mean of a set's S_patch.
    """

    patches: NDArray[np.int64]
    similarity: NDArray[np.float64]
    first: NDArray[np.int64]
    image_similarity: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.first) - 1

    def draw(
        self, sets: Sequence[int], matches: int, numbers: Float[Tensor, "s n"]
    ) -> tuple[Int[Tensor, "2 s n"], Float[Tensor, "s n"]]:
        """n = `matches` different matches of each of the sets, as random numbers in [0, 1) choose them.

        Returns the indices of their patches and their S_patch.
        """
        rows = []
        for i, row in zip(sets, numbers.tolist(), strict=True):
            left = list(range(int(self.first[i]), int(self.first[i + 1])))
            for k in range(matches):  # Fisher and Yates
                other = k + int(row[k] * (len(left) - k))
                left[k], left[other] = left[other], left[k]
            rows.append(left[:matches])
        index = np.array(rows).reshape(len(rows), matches)
        return from_numpy(self.patches[:, index]), from_numpy(self.similarity[index])


def match_sets(tracks: Tracks, matches: int, max_similarity: float = MAX_SIMILARITY) -> MatchSets:
    """The sets of pairs of photographs that share at least `matches` points and are not more alike than allowed.

    S_image, the similarity of two photographs, is the mean S_patch of their shared points (section 3.3). In the order
    of the first photograph and then of the second; matches in the order of their points. Patches without a known
    incidence angle match nothing.

    Raises ValueError where no pair is left.
    """
    pairs = _pairs_of_points(tracks.first)
    known = np.isfinite(tracks.incidence)
    pairs = pairs[:, known[pairs].all(0)]
    swapped = tracks.view[pairs[0]] > tracks.view[pairs[1]]
    pairs = np.where(swapped, pairs[::-1], pairs)
    view0, view1 = tracks.view[pairs]
    order = np.lexsort((pairs[0], view1, view0))
    pairs, view0, view1 = pairs[:, order], view0[order], view1[order]
    a, b = pairs
    similarity = patch_similarity(tracks.rays[a], tracks.rays[b], tracks.incidence[a], tracks.incidence[b])
    begins = np.flatnonzero(np.r_[True, (np.diff(view0) != 0) | (np.diff(view1) != 0)][: len(a)])
    counts = np.diff(np.r_[begins, len(a)])
    image = np.add.reduceat(similarity, begins) / counts if len(begins) else np.zeros(0)
    kept = (counts >= matches) & (image <= max_similarity)
    if not kept.any():
        raise ValueError(
            f"no pair of photographs shares {matches} points and has a similarity of at most {max_similarity}: "
            "lower match_sets.matches, or cut more points"
        )
    of_kept = np.repeat(kept, counts)
    return MatchSets(pairs[:, of_kept], similarity[of_kept], np.r_[0, np.cumsum(counts[kept])], image[kept])


def _pairs_of_points(first: NDArray[np.int64]) -> NDArray[np.int64]:
    """All pairs (2, k) of patches of the same point."""
    counts = np.diff(first)
    parts = [np.zeros((2, 0), np.int64)]
    for length in np.unique(counts[counts >= 2]):
        i, j = np.triu_indices(length, 1)
        start = first[:-1][counts == length][:, None]
        parts.append(np.stack([(start + i).ravel(), (start + j).ravel()]))
    return np.concatenate(parts, axis=1)
