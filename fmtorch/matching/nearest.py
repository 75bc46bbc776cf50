"""Exhaustive two-nearest-neighbour matching in row blocks, exact and reproducible to the bit.

On a CPU, kernels compute the exact distances of the few that may be neighbours by their 8-bit products (`eight_bit`);
elsewhere, and where those tell too few apart, all distances are computed. The result is the same."""

import dataclasses
import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core.types import Correspondences, Features
from fmtorch.geometry.arithmetic import sqrt, stable_sum
from fmtorch.jit.kernel import Array, F8x1, I1x2, I4x1, I4x2, I8x1, inner, kernel, off
from fmtorch.jobs.execution import one_thread

# Two nearest neighbours, compiled: products of 8-bit integers leave few candidates, whose distances are exact

GROUP = 32  # columns that are passed over together where none can be a neighbour
FAR = 1 << 30  # squared 8-bit distance of a column of padding; those of others are less
_MAX_INT32 = 2**31 - 1


class Descriptors(NamedTuple):
    """Descriptors of an image, ``exact = center + step * rounded`` up to a distance of `error`.
    exact: (n, d) integers, at most 2^25 in norm. squared_norms: (n,) of the rounded ones, FAR for padding."""

    exact: I4x2
    squared_norms: I4x1
    error: float
    step: float


class Nearest(NamedTuple):
    """Neighbours and exact squared distances so far, (rows,) and (columns,); FAR-fetched ones are infinite.
    limit: (columns + padding,) the largest 8-bit squared distance at which a row may be nearer than `reverse`."""

    nearest: I8x1
    squared: F8x1
    second_squared: F8x1
    reverse: I8x1
    reverse_squared: F8x1
    limit: I4x1


@kernel
def round_to_8_bits(exact: I4x2, center: float, step: float, rounded: I1x2, squared_norms: I4x1) -> float:
    """Rounds descriptors (n, d) to 8 bits, in units of `step` from `center`, and returns the largest error's norm."""
    largest = 0.0
    for i in range(len(exact)):
        norm, error = 0, 0.0
        for k in range(exact.shape[1]):
            value = (exact[i, k] - center) / step
            nearest = min(max(np.rint(value), -128.0), 127.0)
            rounded[i, k] = np.int8(nearest)
            norm += int(nearest) * int(nearest)
            error += (value - nearest) * (value - nearest)
        squared_norms[i] = norm
        largest = max(largest, error)
    return math.sqrt(largest) * step


@kernel
def update(products: I4x2, first: int, rows: Descriptors, columns: Descriptors, neighbors: Nearest) -> int:
    """Takes products of rounded rows, from `first` on, with all rounded columns into what is found; overwrites them.
    A distance D and the distance D8 of what was rounded differ by the errors at most (triangle inequality), so that
    none beyond a bound on D8 needs to be computed. Returns how many were."""
    groups = products.shape[1] // GROUP
    minima = np.empty(groups, np.int32)
    error, step = rows.error + columns.error, rows.step
    computed = 0
    for i in range(len(products)):
        row, squared = first + i, products[i]
        norm, exact = rows.squared_norms[row], rows.exact[row]
        for g in range(groups):
            begin = g * GROUP
            smallest, excess = np.int32(_MAX_INT32), np.int32(_MAX_INT32)
            for j in range(begin, begin + GROUP):
                value = np.int32(np.int32(norm + columns.squared_norms[j]) - np.int32(2 * squared[j]))
                squared[j] = value
                smallest = min(smallest, value)
                excess = min(excess, np.int32(value - neighbors.limit[j]))
            minima[g] = smallest
            if excess <= 0:
                for j in range(begin, begin + GROUP):
                    if squared[j] <= neighbors.limit[j]:
                        distance = _squared_distance(exact, columns.exact[j])
                        computed += 1
                        if distance < neighbors.reverse_squared[j]:
                            neighbors.reverse[j], neighbors.reverse_squared[j] = row, distance
                            neighbors.limit[j] = _below(distance, error, step)
        computed += _search(row, squared, minima, rows, columns, neighbors)
    return computed


@inner
def _search(
    row: int, squared: Array, minima: Array, rows: Descriptors, columns: Descriptors, neighbors: Nearest
) -> int:
    """The two nearest columns of a row, by 8-bit squared distances and their minima in groups; what was computed."""
    error, step = rows.error + columns.error, rows.step
    limit = _reach(minima, error, step)
    best, second, nearest, computed = math.inf, math.inf, -1, 0
    for g in range(len(minima)):
        if minima[g] > limit:
            continue
        for j in range(g * GROUP, (g + 1) * GROUP):
            if squared[j] > limit:
                continue
            distance = _squared_distance(rows.exact[row], columns.exact[j])
            computed += 1
            if distance < best:
                best, second, nearest = distance, best, j
            elif distance < second:
                second = distance
            limit = min(limit, _below(second, error, step))
    neighbors.nearest[row], neighbors.squared[row], neighbors.second_squared[row] = nearest, best, second
    return computed


@inner
def _reach(minima: Array, error: float, step: float) -> int:
    """The largest 8-bit squared distance that either of the two nearest columns can have, by the minima of groups."""
    first, second = FAR - 1, FAR - 1
    for value in minima:
        if value < first:
            first, second = value, first
        elif value < second:
            second = value
    if error == 0:
        return second
    reach = (math.sqrt(second) + 2 * error / step) * (1 + 1e-9)
    return min(int(reach * reach), FAR - 1)


@inner
def _below(squared: float, error: float, step: float) -> int:
    """The largest 8-bit squared distance that a column can have whose exact one is less than this."""
    if squared == math.inf:
        return FAR - 1
    if error == 0:
        return int(squared / (step * step)) - 1
    reach = (math.sqrt(squared) + error) / step * (1 + 1e-9)
    return min(int(reach * reach), FAR - 1)


@inner
def _squared_distance(a: Array, b: Array) -> float:
    """|a - b|^2, exact: in integers, which add in any order."""
    total = np.int64(0)
    for k in range(len(a)):
        difference = np.int64(np.int32(a[k] - b[k]))
        total += difference * difference
    return float(total)


BLOCK = 128  # rows whose products with all columns exist at a time: 4 MB at 8,000 columns
MAX_COMPUTED = 256  # exact distances a descriptor, beyond which rounding does not help: nearly equal ones
MAX_LENGTH = 1 << 10  # of a descriptor: products stay below 2^24, exact in float32, and squared distances below FAR
MAX_NORM = 2.0**25  # of a descriptor: differences fit 32 bits, and squared distances float64
_RANGE = 255  # between the least and the largest 8-bit integer


def two_nearest(rows: Tensor, columns: Tensor, block: int = BLOCK) -> Nearest | None:
    """Of integer-valued descriptors (n0, d), (n1, d), at most 2^25 in norm; None where rounding tells too few apart."""
    (n0, length), n1 = rows.shape, len(columns)
    if not 1 <= length <= MAX_LENGTH:
        return None
    bounds = [value.item() for each in (rows, columns) for value in each.aminmax()]
    low, high = min(bounds), max(bounds)
    if not max(-low, high) <= MAX_NORM:  # squares that overflow leave no sound scale
        return None
    fits = high - low <= _RANGE
    center, step = (low + 128, 1.0) if fits else ((low + high) / 2, (high - low) / _RANGE)
    padded = -(-n1 // GROUP) * GROUP
    rounded0, first = _rounded(rows, center, step, n0)
    rounded1, second = _rounded(columns, center, step, padded)
    no_rows, no_columns = ((np.full(n, -1), np.full(n, np.inf)) for n in (n0, n1))
    neighbors = Nearest(*no_rows, np.full(n0, np.inf), *no_columns, np.full(padded, FAR - 1, np.int32))
    multiply = torch._int_mm if int8_products_are_exact() else _float_products
    transposed = rounded1.T
    if multiply is _float_products:
        rounded0, transposed = rounded0.float(), transposed.float().contiguous()
    computed, buffer = 0, torch.empty(min(block, n0), padded, dtype=torch.int32)
    for start in range(0, n0, block):
        products = buffer[: n0 - start]
        multiply(rounded0[start : start + block], transposed, out=products)
        computed += update(products.numpy(), start, first, second, neighbors)
        if computed > MAX_COMPUTED * (n0 + n1):
            return None
    return neighbors


@functools.cache
def int8_products_are_exact() -> bool:
    """Whether torch multiplies matrices of 8-bit integers exactly: it does not on processors without VNNI."""
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randint(-128, 128, (128, 256), generator=generator, dtype=torch.int8) for _ in range(2))
    try:
        return torch.equal(torch._int_mm(a, b.T), (a.float() @ b.T.float()).int())
    except (AttributeError, RuntimeError, NotImplementedError):
        return False


def _float_products(a: Tensor, b: Tensor, out: Tensor) -> None:
    """Products of integer-valued float32 matrices: exact, as sums below 2^24 are."""
    out.copy_(a @ b)


def _rounded(values: Tensor, center: float, step: float, padded: int) -> tuple[Tensor, Descriptors]:
    """The descriptors in 8 bits, with rows of zeros up to so many, and what the kernel is to know of them."""
    exact = values.int().numpy()
    rounded = torch.zeros(padded, values.shape[1], dtype=torch.int8)
    norms = np.full(padded, FAR, np.int32)
    error = round_to_8_bits(exact, float(center), float(step), rounded.numpy(), norms)
    return rounded, Descriptors(exact, norms, error * (1 + 1e-9), float(step))


_FLOAT32_NORM = 2.0**11  # integer vectors no longer than this have squared distances up to 2^24: exact in float32
_ROUNDING = 1e-9  # relative, of a float64 norm; a generous bound


class Neighbors(NamedTuple):
    """What `nearest_neighbors` finds, for every descriptor of image 0.
    nearest: index of its nearest neighbour in image 1 (lowest index on ties), -1 where there is none.
    distance, second: Euclidean distances to the nearest and the second nearest, infinite where there is none.
    reverse: for every descriptor of image 1 its nearest neighbour in image 0, -1 where there is none."""

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
    descriptors0: Float[Tensor, "*batch n0 d"], descriptors1: Float[Tensor, "*batch n1 d"],
    mask0: Bool[Tensor, "*batch n0"] | None = None, mask1: Bool[Tensor, "*batch n1"] | None = None, *,
    chunk: int = 1024,
) -> Neighbors:  # fmt: skip
    """The two nearest descriptors of image 1 for each of image 0, and the nearest the other way, in one pass.
    Squared distances are computed as integers, so no rounding can depend on the batch, the block or the device: integer
    descriptors such as SIFT's are taken as they are, others on a grid of 2^-25 of the longest descriptor of the pair.
    Where no kernels run, as on a GPU, `chunk` rows of the distance matrix exist at a time: it changes speed and memory,
    never the result. Masked and non-finite descriptors neither have neighbours nor are any. Not differentiable."""
    if chunk < 1:
        raise ValueError(f"chunk is {chunk}; it must be at least 1")
    batch, (n0, n1) = descriptors0.shape[:-2], (descriptors0.shape[-2], descriptors1.shape[-2])
    flat0, flat1 = (d.reshape(math.prod(batch), *d.shape[-2:]) for d in (descriptors0, descriptors1))
    with one_thread(descriptors0.device):
        masks = _finite(flat0, mask0), _finite(flat1, mask1)
        by_pair = [_match_one_pair(*pair, chunk) for pair in zip(flat0, flat1, *masks, strict=True)]
    if not by_pair:
        return Neighbors(*(column.expand(*batch, -1) for column in _nothing(descriptors0, n0, n1)))
    columns = [torch.stack(column) for column in zip(*by_pair, strict=True)]
    return Neighbors(*(column.reshape(*batch, column.shape[-1]) for column in columns))


def _finite(flat: Tensor, mask: Tensor | None) -> Tensor:
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
    neighbors = two_nearest(rows, columns) if rows.device.type == "cpu" and not off() else None
    if neighbors is None:
        (nearest, *squared), reverse = _two_nearest(rows, columns, chunk)
    else:
        nearest, *squared, reverse = (torch.from_numpy(values) for values in neighbors[:4])
    result.nearest[slots0], result.reverse[slots1] = slots1[nearest], slots0[reverse]
    for distance, values in zip((result.distance, result.second), squared, strict=True):
        distance[slots0] = (sqrt(values.double()) * unit).float()
    return result


def _integers(d0: Tensor, d1: Tensor) -> tuple[Tensor, Tensor, float]:
    """Both sets as integer-valued vectors in a type in which their squared distances are exact, and their unit."""
    longest = max(_longest(d0), _longest(d1))
    integral = bool((d0 == d0.round()).all() and (d1 == d1.round()).all())
    if integral and longest <= _FLOAT32_NORM and not d0.is_cuda:  # where factors may be rounded to 11 bits (TF32)
        return d0.float(), d1.float(), 1.0
    ratio = MAX_NORM / longest if longest > 0 else 1.0  # squares below 1e-323 are zero, and so is all that is left
    exponent = math.frexp(ratio)[1] - 1  # a power of two, so that scaling is exact
    scale = 2.0 ** min(exponent, 1000)
    return (d0.double() * scale).round(), (d1.double() * scale).round(), 1.0 / scale


def _longest(d: Tensor) -> float:
    """The largest norm, to the bit; exact arithmetic is left to those that are the largest up to rounding."""
    norms = torch.linalg.vector_norm(d, dim=-1, dtype=torch.float64)
    return float(sqrt(stable_sum(d[norms >= norms.max() * (1 - _ROUNDING)].double().square())).max())


def _two_nearest(rows: Tensor, columns: Tensor, chunk: int) -> tuple[list[Tensor], Tensor]:
    """Of every row the nearest column, its and the second's squared distance; of every column the nearest row. Exact.
    |a - b|^2 = [a, |a|^2, 1] . [-2 b, 1, |b|^2]: one product a block, padded to whole groups with infinite columns."""
    n1 = len(columns)
    norm0, norm1 = (d.square().sum(-1, keepdim=True) for d in (rows, columns))
    left = torch.cat([rows, norm0, torch.ones_like(norm0)], 1)
    right = left.new_zeros(-(-n1 // GROUP) * GROUP, left.shape[1])
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
    return [torch.cat(column) for column in zip(*blocks, strict=True)], reverse[:n1]


def _two_smallest(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of every row the first index of its smallest value, that value and the second smallest.
    The minima of groups of columns lead to the smallest value; the second is in its group or another's minimum."""
    groups = squared.reshape(len(squared), -1, GROUP)
    minima = groups.amin(-1)
    group = minima.argmin(1, keepdim=True)
    members = groups.gather(1, group[..., None].expand(-1, -1, GROUP))[:, 0]
    member = members.argmin(1, keepdim=True)
    best = members.gather(1, member)
    rest = members.scatter(1, member, math.inf).amin(1, keepdim=True)
    second = minima.scatter(1, group, rest).amin(1)
    return (group * GROUP + member)[:, 0], best[:, 0], second


@dataclasses.dataclass(frozen=True)
class NearestNeighborMatcher:
    """Matches every feature of image 0 with the feature of image 1 whose descriptor is nearest (Euclidean).

    The slots of the result are the features of image 0, in their order; `mask` is True for those that found a
    partner. `ratio` is the ratio of the distances to the nearest and the second nearest descriptor, in [0, 1], and
    1 where it means nothing (a single candidate, two identical candidates).

    mutual: keep only matches whose partner's own nearest neighbour is the feature itself. It costs nothing, both
    directions being found in one pass; without it the result says which matches these are (`Correspondences.mutual`).
    chunk: rows of the distance matrix that exist at a time on a GPU; changes speed and memory only."""

    mutual: bool = False
    chunk: int = 1024

    def __call__(self, features0: Features, features1: Features) -> Correspondences:
        """The matches of one pair, or of a batch where features have a leading dimension; ValueError if both differ."""
        shape0, shape1 = features0.descriptors.shape, features1.descriptors.shape
        if shape0[:-2] != shape1[:-2] or shape0[-1] != shape1[-1]:
            both = f"{tuple(shape0)} and {tuple(shape1)}"
            raise ValueError(f"descriptors {both} do not fit: batch and length must be the same")
        if len(shape0) == 2:
            names = [field.name for field in dataclasses.fields(Features)]
            features0, features1 = (
                f.replace(**{n: getattr(f, n)[None] for n in names}) for f in (features0, features1)
            )
        neighbors = nearest_neighbors(
            features0.descriptors, features1.descriptors, features0.valid, features1.valid, chunk=self.chunk
        )
        mask, lafs0, lafs1 = neighbors.nearest >= 0, features0.lafs, _take(features1.lafs, neighbors.nearest)
        frames = {"lafs0": lafs0, "lafs1": lafs1, "size0": features0.image_size, "size1": features1.image_size}
        known = {"ratio": neighbors.ratio.to(lafs0.dtype), "mutual": neighbors.mutual & mask}
        kept = mask & neighbors.mutual if self.mutual else mask
        return Correspondences(features0.keypoints, lafs1[..., 2], kept, **frames, **known)


def _take(lafs: Tensor, index: Int[Tensor, "b n0"]) -> Tensor:
    if lafs.shape[1] == 0:
        return lafs.new_zeros(*index.shape, 2, 3)
    taken = lafs.gather(1, index.clamp(min=0)[..., None, None].expand(-1, -1, 2, 3))
    return torch.where(index[..., None, None] >= 0, taken, 0.0)
