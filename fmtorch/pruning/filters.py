"""Filters by what is known of each match: its ratio, mutuality, location or prior."""

import dataclasses
import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core import Correspondences, Within
from fmtorch.jit.batches import for_each_pair
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, inner, kernel, vector
from fmtorch.jit.random import mix

Points = Float[Tensor, "b n 2"]


def ratio_test(
    ratio: Float[Tensor, "b n"], threshold: float = 0.8, mask: Bool[Tensor, "b n"] | None = None
) -> Bool[Tensor, "b n"]:
    """True where the ratio of the distances to the nearest and second nearest descriptor is below `threshold`.
    The ratio is of Euclidean, not squared, distances; a ratio that is NaN fails. Lowe, IJCV 2004, section 7.1."""
    kept = ratio < threshold
    return kept if mask is None else kept & mask


@dataclasses.dataclass(frozen=True)
class RatioTest:
    """`ratio_test` of the ratios, or of 1 - score, as a stage. Raises ValueError where matches have neither."""

    threshold: Annotated[float, Within(0)] = 0.8

    def __call__(self, c: Correspondences) -> Correspondences:
        if c.ambiguity is None:
            said = "the nearest-neighbour distance ratio of each match"
            raise ValueError(f"the ratio test needs `ratio`, {said}, or `score`")
        return c.keep(ratio_test(c.ambiguity, self.threshold))


class MutualCheck:
    """Matches survive that are the best ones of both features. Raises ValueError where the matcher did not tell."""

    def __call__(self, c: Correspondences) -> Correspondences:
        if c.mutual is None:
            raise ValueError("the mutual check needs `mutual`, which a matcher of both directions supplies")
        return c.keep(c.mutual)


def one_to_one(
    x0: Points, x1: Points, ambiguity: Float[Tensor, "b n"], mask: Bool[Tensor, "b n"] | None = None
) -> Bool[Tensor, "b n"]:
    """True for a match that is the best one at its location in image 0 and the best one at its location in image 1.
    The best has the lowest `ambiguity` (NaN is worst), ties by lowest index. Locations are the same when coordinates
    are exactly equal, as those of one keypoint with several orientations are. The rule is symmetric in the images and
    independent of the order of the matches, ties apart. Matches with a non-finite coordinate are dropped. O(N)."""
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    out = torch.empty(mask.shape, dtype=torch.bool)
    return for_each_pair(one_to_one_kernel, (x0, x1, ambiguity, mask), out=out, kind=torch.float64)


@kernel
def one_to_one_kernel(x0: F8x2, x1: F8x2, ambiguity: F8x1, mask: B1x1, out: B1x1) -> None:
    """`one_to_one` of x0, x1 (n, 2), ambiguity, mask (n,) -> out (n,)."""
    n = len(mask)
    valid, rank = np.empty(n, np.bool_), vector(n)
    for i in range(n):
        finite = math.isfinite(x0[i, 0]) and math.isfinite(x0[i, 1])
        valid[i] = mask[i] and finite and math.isfinite(x1[i, 0]) and math.isfinite(x1[i, 1])
        rank[i] = math.inf if math.isnan(ambiguity[i]) else ambiguity[i]
        out[i] = valid[i]
    _drop_all_but_the_best(x0, rank, valid, out)
    _drop_all_but_the_best(x1, rank, valid, out)


@inner
def _drop_all_but_the_best(x: Array, rank: Array, valid: Array, out: Array) -> None:
    """Sets out[i] to False where another valid match at the same location has a lower (rank, index): a hash table."""
    n = len(valid)
    size = 4
    while size < 2 * n:
        size *= 2
    place, best = np.empty(n, np.int64), np.full(size, -1, np.int64)
    at = x + 0.0  # -0 becomes 0
    bits = at.view(np.uint64)
    for i in range(n):
        if not valid[i]:
            continue
        slot = np.int64(mix(bits[i, 0] + np.uint64(0x9E3779B97F4A7C15) * mix(bits[i, 1])) & np.uint64(size - 1))
        while best[slot] >= 0 and (at[best[slot], 0] != at[i, 0] or at[best[slot], 1] != at[i, 1]):
            slot = (slot + 1) & (size - 1)
        place[i] = slot
        if best[slot] < 0 or rank[i] < rank[best[slot]]:
            best[slot] = i
    for i in range(n):
        if valid[i] and best[place[i]] != i:
            out[i] = False


@dataclasses.dataclass(frozen=True)
class OneToOne:
    """`one_to_one` as a stage. Raises ValueError for correspondences with neither `ratio` nor `score`."""

    def __call__(self, c: Correspondences) -> Correspondences:
        if c.ambiguity is None:
            raise ValueError("one-to-one needs `ratio` or `score`, by which the best match of a location is chosen")
        return c.keep(one_to_one(c.x0, c.x1, c.ambiguity, c.mask))


@dataclasses.dataclass(frozen=True)
class Likely:
    """Keeps the matches whose ``prior``, P(inlier), is at least `min_probability`.
    It makes a filter of any stage that supplies a prior. Raises ValueError for correspondences without a prior."""

    min_probability: float = 0.5

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only likely ones survive; a prior that is NaN fails."""
        if c.prior is None:
            raise ValueError("`likely` needs `prior`: put a stage that supplies it before, e.g. frame_consistency")
        return c.keep(c.prior >= self.min_probability)
