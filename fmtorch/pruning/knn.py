"""Exact nearest neighbours among points of the plane."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

_LEAF = 16  # points a leaf
_LEAVES = 12  # leaves that are searched for the points of a leaf; what they do not settle is searched exhaustively
_DISTANCES_CPU, _DISTANCES_GPU = 2**18, 2**26  # distances that exist at a time
_ATTEMPT = 8  # times as many neighbours as are wanted are asked of the tree where ties are not settled
_LARGEST = 1e150  # coordinate whose square is surely a number
_ROUNDING = 1 + 1e-14  # of squared distances, in the tree's arithmetic and in ours


def nearest_points(queries: Float[Tensor, "n 2"], points: Float[Tensor, "m 2"], count: int) -> Int[Tensor, "n count"]:
    """Indices of the `count` points nearest to each query, nearest first, ties by lowest index; -1 for no more points.

    Exact in float64, except for ties within a few roundings. Memory linear in n + m. On a CPU by SciPy's k-d tree, with
    as many threads as torch has; elsewhere by packed leaves.
    """
    nearest = torch.full((len(queries), count), -1, device=queries.device)
    wanted = min(count, len(points))
    if wanted and len(queries):
        queries, points = _in_range(queries.detach().double(), points.detach().double())
        search = by_tree if queries.device.type == "cpu" else by_leaves
        nearest[:, :wanted] = search(queries, points, wanted)
    return nearest


def _in_range(queries: Float[Tensor, "n 2"], points: Float[Tensor, "m 2"]) -> tuple[Tensor, Tensor]:
    """Both, divided by a power of two where squares of their coordinates would overflow."""
    largest = max(float(x.abs().max()) for x in (queries, points))
    if not _LARGEST < largest < math.inf:
        return queries, points
    exponent = math.frexp(largest)[1]
    return queries * 0.5**exponent, points * 0.5**exponent


def by_tree(queries: Float[Tensor, "n 2"], points: Float[Tensor, "m 2"], count: int) -> Int[Tensor, "n count"]:
    """`nearest_points` by a k-d tree, for 1 <= count <= m.

    The tree breaks ties in no fixed order: so more neighbours are asked for, until the last is farther than the ones
    that are wanted, and what one attempt with many does not settle is searched exhaustively.
    """
    at, places = queries.numpy(), points.numpy()
    tree = KDTree(places)
    nearest = np.empty((len(at), count), np.int64)
    todo = np.arange(len(at))
    for asked in (min(count + 1, len(places)), min(_ATTEMPT * count, len(places))):
        unsettled = []
        for rows in np.array_split(todo, -(-len(todo) * asked // _DISTANCES_CPU)) if len(todo) else ():
            index = tree.query(at[rows], np.arange(1, asked + 1), workers=torch.get_num_threads())[1]
            (dx, dy) = (places[index, i] - at[rows, None, i] for i in (0, 1))
            squared = dx * dx + dy * dy
            equal = np.flatnonzero((squared[:, 1:] <= squared[:, :-1]).any(1))
            order = np.lexsort((index[equal], squared[equal]))
            index[equal], squared[equal] = (np.take_along_axis(v[equal], order, 1) for v in (index, squared))
            nearest[rows] = index[:, :count]
            if asked < len(places):
                unsettled.append(rows[squared[:, -1] <= squared[:, count - 1] * _ROUNDING])
        todo = np.concatenate([np.empty(0, np.int64), *unsettled])
    rest = torch.from_numpy(todo)
    result = torch.from_numpy(nearest)
    for part in torch.split(rest, max(1, _DISTANCES_CPU // len(places))):
        result[part] = _smallest(_squared(queries[part], points), count)[0]
    return result


def by_leaves(queries: Float[Tensor, "n 2"], points: Float[Tensor, "m 2"], count: int) -> Int[Tensor, "n count"]:
    """`nearest_points` for 1 <= count <= m in operations on tensors alone.

    Queries and points are packed into rectangular leaves (sort-tile-recursive: Leutenegger et al., ICDE 1997). The
    points of the nearest leaves are candidates, and settle a query when the last neighbour found is nearer than any
    other leaf can be; what is left is searched exhaustively.
    """
    neighbors = torch.full((len(queries), count), -1, device=queries.device)
    homes, leaves = _pack(queries), _pack(points)  # (H, 16), (L, 16), -1 for empty places
    boxes = _boxes(points, leaves)
    budget = _DISTANCES_CPU if queries.device.type == "cpu" else _DISTANCES_GPU
    unsettled = []
    for home in torch.split(homes, max(1, budget // (_LEAF * max(_LEAVES * _LEAF, len(leaves) // _LEAF)))):
        nearest, gap = _nearest_leaves(_boxes(queries, home), boxes)
        candidates = leaves[nearest].flatten(1).sort(1).values  # (H, C), by index: ties go to the lowest
        squared = _squared(queries[home], points[candidates])  # (H, 16, C)
        squared.masked_fill_((candidates < 0)[:, None], math.inf)
        columns, last = _smallest(squared, min(count, squared.shape[-1]))
        real = home >= 0
        index = candidates[:, None].expand(-1, _LEAF, -1).gather(2, columns)[real]
        neighbors[home[real], : index.shape[1]] = index
        unsettled.append(home[real & ((last >= gap[:, None]) | (index.shape[1] < count))])
    for rows in torch.split(torch.cat(unsettled), max(1, budget // len(points))):
        neighbors[rows] = _smallest(_squared(queries[rows], points), count)[0]
    return neighbors


def _squared(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (..., n, m) between a (..., n, 2) and b (..., m, 2)."""
    dx, dy = (a[..., :, None, i] - b[..., None, :, i] for i in (0, 1))
    return dx.square_() + dy.square_()


def _smallest(values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Indices of the `count` smallest values of each row, in order, the first of equals first; and the last of them.

    Destroys the values. The minima of groups of columns lead to the group with the smallest value, of which alone the
    minimum is found anew when that value is taken. (`topk` would take any of equals.)
    """
    short = -values.shape[-1] % _LEAF
    values = torch.nn.functional.pad(values, (0, short), value=math.inf) if short else values
    grouped = values.unflatten(-1, (-1, _LEAF))  # type: ignore[no-untyped-call]
    minima = grouped.amin(-1)
    columns = []
    for _ in range(count):
        group = minima.argmin(-1, keepdim=True)
        members = grouped.gather(-2, group[..., None].expand(*group.shape, _LEAF))[..., 0, :]
        member = members.argmin(-1, keepdim=True)
        last = members.gather(-1, member)
        column = group * _LEAF + member
        values.scatter_(-1, column, math.inf)
        minima.scatter_(-1, group, members.scatter_(-1, member, math.inf).amin(-1, keepdim=True))
        columns.append(column)
    return torch.cat(columns, -1), last[..., 0]


def _pack(x: Float[Tensor, "n 2"]) -> Int[Tensor, "leaves size"]:
    """Indices of the points in leaves: strips of equal count along x, cut into leaves along y; -1 for empty places."""
    leaves = -(-len(x) // _LEAF)
    strips = math.ceil(math.sqrt(leaves))
    length = -(-leaves // strips) * _LEAF
    index = torch.full((strips * length,), -1, device=x.device)
    index[: len(x)] = x[:, 0].argsort()
    index = index.reshape(strips, length)
    y = torch.where(index >= 0, x[index, 1], math.inf)
    return index.gather(1, y.argsort(1)).reshape(-1, _LEAF)


def _boxes(x: Tensor, leaves: Tensor) -> tuple[Tensor, Tensor]:
    """Lower and upper corners (L, 2) of the leaves; infinite and reversed for an empty one."""
    empty = (leaves < 0)[..., None]
    return x[leaves].masked_fill(empty, math.inf).amin(1), x[leaves].masked_fill(empty, -math.inf).amax(1)


def _nearest_leaves(homes: tuple[Tensor, Tensor], leaves: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """For every home its nearest leaves, and the least squared distance to any other; no distance rounds below it."""
    (low0, high0), (low1, high1) = homes, leaves
    dx, dy = (
        torch.maximum(low1[:, i] - high0[:, None, i], low0[:, None, i] - high1[:, i]).clamp_(min=0).square_()
        for i in (0, 1)
    )
    apart = dx.add_(dy)
    if len(low1) <= _LEAVES:
        return torch.arange(len(low1), device=low1.device).expand(len(low0), -1), apart.new_full((len(low0),), math.inf)
    bound, index = apart.topk(_LEAVES + 1, largest=False)
    return index[:, :-1], bound[:, -1]
