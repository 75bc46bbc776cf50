"""Exhaustive two-nearest-neighbour matching in row blocks, exact and reproducible to the bit.

On a CPU, kernels compute the exact distances of the few that may be neighbours by their 8-bit products (`eight_bit`);
elsewhere, and where those tell too few apart, all distances are computed. The result is the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.compiling.batches import kernels_serve
from fmtorch.geometry.arithmetic import sqrt, stable_sum
from fmtorch.jobs.threads import one_thread
from fmtorch.matching import eight_bit

_GROUP = 32  # columns whose minimum is taken together; a group is searched only where it can hold a neighbour
_FLOAT32_NORM = 2.0**11  # integer vectors no longer than this have squared distances up to 2^24: exact in float32
_ROUNDING = 1e-9  # relative, of a float64 norm; a generous bound
_FLOAT64_NORM = 2.0**25  # likewise 2^52 in float64


class Neighbors(NamedTuple):
    """What `nearest_neighbors` finds, for every descriptor of image 0.

    nearest: index of its nearest neighbour in image 1 (lowest index on ties), -1 where there is none.
    distance, second: Euclidean distances to the nearest and the second nearest, infinite where there is none.
    reverse: for every descriptor of image 1 its nearest neighbour in image 0, -1 where there is none.
    """

    nearest: Int[Tensor, "*batch n0"]
    distance: Float[Tensor, "*batch n0"]
    second: Float[Tensor, "*batch n0"]
    reverse: Int[Tensor, "*batch n1"]

    @property
    def ratio(self) -> Float[Tensor, "*batch n0"]:
        """distance / second in [0, 1]; 1 where no second neighbour makes the first distinctive (one candidate, 0/0)."""
        distinctive = torch.isfinite(self.second) & (self.second > 0)
        return torch.where(distinctive, self.distance / torch.where(distinctive, self.second, 1.0), 1.0)

    @property
    def mutual(self) -> Bool[Tensor, "*batch n0"]:
        """True where the nearest neighbour's own nearest neighbour is the descriptor itself."""
        if self.reverse.shape[-1] == 0:
            return torch.zeros_like(self.nearest, dtype=torch.bool)
        back = self.reverse.gather(-1, self.nearest.clamp(min=0))
        return (self.nearest >= 0) & (back == torch.arange(self.nearest.shape[-1], device=self.nearest.device))


@torch.no_grad()
def nearest_neighbors(
    descriptors0: Float[Tensor, "*batch n0 d"],
    descriptors1: Float[Tensor, "*batch n1 d"],
    mask0: Bool[Tensor, "*batch n0"] | None = None,
    mask1: Bool[Tensor, "*batch n1"] | None = None,
    *,
    chunk: int = 64,
) -> Neighbors:
    """The two nearest descriptors of image 1 for each of image 0, and the nearest the other way, in one pass.

    Squared distances are computed as integers, so no rounding can depend on the batch, the block or the device:
    integer descriptors such as SIFT's are taken as they are (float32), others on a grid of 2^-25 of the longest
    descriptor of the pair (float64). Only `chunk` rows of the distance matrix exist at a time; `chunk` changes speed
    and memory, never the result. Masked and non-finite descriptors neither have neighbours nor are any.
    Not differentiable.
    """
    if chunk < 1:
        raise ValueError(f"chunk is {chunk}; it must be at least 1")
    with one_thread(descriptors0.device):
        return _nearest_neighbors(descriptors0, descriptors1, mask0, mask1, chunk)


def _nearest_neighbors(
    descriptors0: Tensor, descriptors1: Tensor, mask0: Tensor | None, mask1: Tensor | None, chunk: int
) -> Neighbors:
    batch, (n0, n1) = descriptors0.shape[:-2], (descriptors0.shape[-2], descriptors1.shape[-2])
    flat0, flat1 = (d.reshape(math.prod(batch), *d.shape[-2:]) for d in (descriptors0, descriptors1))
    mask0, mask1 = _finite(flat0, mask0), _finite(flat1, mask1)
    by_pair = [_match_one_pair(*pair, chunk) for pair in zip(flat0, flat1, mask0, mask1, strict=True)]
    if not by_pair:
        by_pair = [_nothing(descriptors0, n0, n1)]
        return Neighbors(*(column.expand(*batch, -1) for column in by_pair[0]))
    return Neighbors(
        *(torch.stack(column).reshape(*batch, column[0].shape[-1]) for column in zip(*by_pair, strict=True))
    )


def _finite(flat: Tensor, mask: Tensor | None) -> Tensor:
    """The mask of the descriptors that are finite."""
    finite = flat.abs().amax(-1) < math.inf if flat.shape[-1] else torch.isfinite(flat).all(-1)
    return finite if mask is None else finite & mask.reshape(finite.shape)


def _nothing(like: Tensor, n0: int, n1: int) -> Neighbors:
    index = torch.full((n0 + n1,), -1, dtype=torch.int64, device=like.device)
    distance = torch.full((n0,), math.inf, device=like.device)
    return Neighbors(index[:n0], distance, distance.clone(), index[n0:])


def _match_one_pair(d0: Tensor, d1: Tensor, mask0: Tensor, mask1: Tensor, chunk: int) -> Neighbors:
    """`nearest_neighbors` of one pair: padding is taken out before anything is computed."""
    result = _nothing(d0, len(d0), len(d1))
    slots0, slots1 = mask0.nonzero()[:, 0], mask1.nonzero()[:, 0]
    if len(slots0) == 0 or len(slots1) == 0:
        return result
    rows, columns, unit = _integers(d0[slots0], d1[slots1])
    nearest, reverse = _compiled(rows, columns) or _two_nearest(rows, columns, chunk)
    result.nearest[slots0] = slots1[nearest.column]
    result.distance[slots0] = (sqrt(nearest.squared.double()) * unit).float()
    result.second[slots0] = (sqrt(nearest.second_squared.double()) * unit).float()
    result.reverse[slots1] = slots0[reverse]
    return result


def _compiled(rows: Tensor, columns: Tensor) -> tuple[_Nearest, Tensor] | None:
    """`_two_nearest` by kernels, None where they do not serve."""
    neighbors = eight_bit.two_nearest(rows, columns) if kernels_serve(rows, columns) else None
    if neighbors is None:
        return None
    tensors = (torch.from_numpy(value) for value in (neighbors.nearest, neighbors.squared, neighbors.second_squared))
    return _Nearest(*tensors), torch.from_numpy(neighbors.reverse)


def _integers(d0: Tensor, d1: Tensor) -> tuple[Tensor, Tensor, float]:
    """Both sets as integer-valued vectors in a type in which their squared distances are exact, and their unit."""
    longest = max(_longest(d0), _longest(d1))
    integral = bool((d0 == d0.round()).all() and (d1 == d1.round()).all())
    if integral and longest <= _FLOAT32_NORM:
        return d0.float(), d1.float(), 1.0
    ratio = _FLOAT64_NORM / longest if longest > 0 else 1.0  # squares below 1e-323 are zero, and so is all that is left
    exponent = math.frexp(ratio)[1] - 1  # a power of two, so that scaling is exact
    scale = 2.0 ** min(exponent, 1000)
    return (d0.double() * scale).round(), (d1.double() * scale).round(), 1.0 / scale


def _longest(d: Tensor) -> float:
    """The largest norm, to the bit; exact arithmetic is left to those that are the largest up to rounding."""
    norms = torch.linalg.vector_norm(d, dim=-1, dtype=torch.float64)
    return float(sqrt(stable_sum(d[norms >= norms.max() * (1 - _ROUNDING)].double().square())).max())


class _Nearest(NamedTuple):
    column: Tensor
    squared: Tensor
    second_squared: Tensor


def _two_nearest(rows: Tensor, columns: Tensor, chunk: int) -> tuple[_Nearest, Tensor]:
    """Two nearest columns of every row and the nearest row of every column, by exact squared distances.

    |a - b|^2 = [a, |a|^2, 1] . [-2 b, 1, |b|^2]: one product a block, padded to whole groups with infinite columns.
    """
    n1 = len(columns)
    norm0, norm1 = (d.square().sum(-1, keepdim=True) for d in (rows, columns))
    left = torch.cat([rows, norm0, torch.ones_like(norm0)], 1)
    right = left.new_zeros(-(-n1 // _GROUP) * _GROUP, left.shape[1])
    right[:, -1] = math.inf
    right[:n1] = torch.cat([-2 * columns, torch.ones_like(norm1), norm1], 1)
    right = right.T.contiguous()

    best_of_column = left.new_full((right.shape[1],), math.inf)
    reverse = torch.zeros(right.shape[1], dtype=torch.int64, device=left.device)
    blocks = []
    for start in range(0, len(left), chunk):
        squared = left[start : start + chunk] @ right
        block_best = squared.amin(0)
        improved = (block_best < best_of_column).nonzero()[:, 0]
        reverse[improved] = squared[:, improved].argmin(0) + start
        best_of_column = torch.minimum(best_of_column, block_best)
        blocks.append(_two_smallest(squared))
    return _Nearest(*(torch.cat(column) for column in zip(*blocks, strict=True))), reverse[:n1]


def _two_smallest(squared: Tensor) -> _Nearest:
    """Of every row the first index of its smallest value, that value and the second smallest.

    The minima of groups of columns lead to the group with the smallest value; the second smallest is in the same
    group or is the minimum of another one.
    """
    groups = squared.reshape(len(squared), -1, _GROUP)
    minima = groups.amin(-1)
    group = minima.argmin(1, keepdim=True)
    members = groups.gather(1, group[..., None].expand(-1, -1, _GROUP))[:, 0]
    member = members.argmin(1, keepdim=True)
    best = members.gather(1, member)
    rest = members.scatter(1, member, math.inf).amin(1, keepdim=True)
    second = minima.scatter(1, group, rest).amin(1)
    return _Nearest((group * _GROUP + member)[:, 0], best[:, 0], second)
