"""Neighbours in the plane: exact ones, by a balanced k-d tree whose nodes are known by arithmetic, and what they tell.

That is the map between the surroundings of a match, and which matches LPM keeps. Then cheaper ones, by orders of the
matches along space-filling (Morton) curves, in which neighbours in an image mostly stand together."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import smallest_but
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, F8x3, I8x1, for_each_pair, inner, kernel, matrix, vector
from fmtorch.pruning.calibration import calibration_of

_LEAF = 8  # points a leaf, at most


@inner
def search(queries: Array, points: Array, neighbors: Array) -> None:
    """The nearest points (m, 2) of queries (n, 2): indices, neighbors (n, count), nearest first; -1 past the last.
    Squared distances in float64, ties by index, exactly as an exhaustive search finds them. Node j of depth d holds the
    places from (j m) >> d on in an order of the points, its box and their lowest index."""
    m = len(points)
    neighbors[:] = -1
    if m == 0:
        return
    depth = 0
    while ((m - 1) >> depth) >= _LEAF:
        depth += 1
    order = _order(points, depth)
    boxes, lowest = _boxes(points, order, depth)
    stack, distances = np.empty((depth + 2, 3), np.int64), np.empty(neighbors.shape[1])
    bounds = vector(depth + 2)
    for i in range(len(queries)):
        x, y = queries[i, 0], queries[i, 1]
        distances[:] = math.inf
        filled, height = 0, 1
        stack[0, 0], stack[0, 1], bounds[0] = 0, 0, 0.0
        while height:
            height -= 1
            d, j, bound = stack[height, 0], stack[height, 1], bounds[height]
            if filled == len(distances):
                last = distances[filled - 1]
                if bound > last or (bound == last and lowest[(1 << d) + j] > neighbors[i, filled - 1]):
                    continue
            if d < depth:
                node = (2 << d) + 2 * j
                near, far = _outside(boxes[node], x, y), _outside(boxes[node + 1], x, y)
                first = 0 if near < far or (near == far and lowest[node] < lowest[node + 1]) else 1
                stack[height, 0], stack[height, 1], bounds[height] = d + 1, 2 * j + 1 - first, max(near, far)
                stack[height + 1, 0], stack[height + 1, 1], bounds[height + 1] = d + 1, 2 * j + first, min(near, far)
                height += 2
                continue
            for place in range((j * m) >> d, ((j + 1) * m) >> d):
                index = order[place]
                dx, dy = points[index, 0] - x, points[index, 1] - y
                filled = _insert(dx * dx + dy * dy, index, distances, neighbors[i], filled)


@inner
def _insert(squared: float, index: int, distances: Array, neighbors: Array, filled: int) -> int:
    """Inserts a point among the nearest so far, sorted by (distance, index); their number."""
    k = filled
    if k == len(neighbors):
        k -= 1
        if squared > distances[k] or (squared == distances[k] and index > neighbors[k]):
            return filled
    while k > 0 and (squared < distances[k - 1] or (squared == distances[k - 1] and index < neighbors[k - 1])):
        distances[k], neighbors[k] = distances[k - 1], neighbors[k - 1]
        k -= 1
    distances[k], neighbors[k] = squared, index
    return min(filled + 1, len(neighbors))


@inner
def _outside(box: Array, x: float, y: float) -> Any:
    """The squared distance of a point from a box (low x, low y, high x, high y); no point in it rounds to less."""
    dx, dy = max(max(box[0] - x, x - box[2]), 0.0), max(max(box[1] - y, y - box[3]), 0.0)
    return dx * dx + dy * dy


@inner
def _order(points: Array, depth: int) -> Array:
    """Indices of the points (m,) such that each node's stand together."""
    m = len(points)
    order = np.arange(m)
    for d in range(depth):
        for j in range(1 << d):
            begin, end, middle = (j * m) >> d, ((j + 1) * m) >> d, ((2 * j + 1) * m) >> (d + 1)
            low, high = points[order[begin]].copy(), points[order[begin]].copy()
            for place in range(begin, end):
                for k in range(2):
                    low[k], high[k] = min(low[k], points[order[place], k]), max(high[k], points[order[place], k])
            _split(points, 0 if high[0] - low[0] >= high[1] - low[1] else 1, order, begin, end, middle)
    return order


@inner
def _split(points: Array, axis: int, order: Array, begin: int, end: int, middle: int) -> None:
    """Reorders order[begin:end] so that no coordinate before `middle` is larger than one from there on."""
    n = end - begin
    index, values = order[begin:end].copy(), np.empty(n, points.dtype)
    for i in range(n):
        values[i] = points[index[i], axis]
    median = smallest_but(values, 0, n, middle - begin)
    below, same = begin, 0
    for i in range(n):
        below += points[index[i], axis] < median
        same += points[index[i], axis] == median
    first, second, third = begin, below, below + same
    for i in range(n):
        value = points[index[i], axis]
        if value < median:
            order[first] = index[i]
            first += 1
        elif value == median:
            order[second] = index[i]
            second += 1
        else:
            order[third] = index[i]
            third += 1


@inner
def _boxes(points: Array, order: Array, depth: int) -> tuple[Array, Array]:
    """Low and high corners (2^(depth + 1), 4) of the nodes and their lowest indices; node j of depth d at 2^d + j."""
    m, leaves = len(points), 1 << depth
    boxes, lowest = matrix(2 * leaves, 4), np.empty(2 * leaves, np.int64)
    for node in range(2 * leaves - 1, 0, -1):
        if node < leaves:
            for k in range(2):
                boxes[node, k] = min(boxes[2 * node, k], boxes[2 * node + 1, k])
                boxes[node, 2 + k] = max(boxes[2 * node, 2 + k], boxes[2 * node + 1, 2 + k])
            lowest[node] = min(lowest[2 * node], lowest[2 * node + 1])
            continue
        j = node - leaves
        boxes[node, 0], boxes[node, 1], boxes[node, 2], boxes[node, 3] = math.inf, math.inf, -math.inf, -math.inf
        lowest[node] = m
        for place in range((j * m) >> depth, ((j + 1) * m) >> depth):
            index = order[place]
            lowest[node] = min(lowest[node], index)
            for k in range(2):
                boxes[node, k] = min(boxes[node, k], points[index, k])
                boxes[node, 2 + k] = max(boxes[node, 2 + k], points[index, k])
    return boxes, lowest


# The map between the surroundings of a match where there are no frames: a similarity that its neighbours agree on

NEIGHBOURS = 16
MIN_AGREEING = 3  # neighbours, without which there is no map
TOLERANCE, NOISE_PX = 0.15, 1.0  # of a prediction: relative to the neighbour's distance, and of its position


@kernel
def neighbour_maps(x0: F8x2, x1: F8x2, out: F8x3) -> None:
    """Of each of n matches, points x0, x1 (n, 2), the similarity around it -> out (n, 2, 2); NaN for none.
    Each of its nearest neighbours in image 0 proposes the one that maps it exactly. Of the proposal with which most
    neighbours agree, the first of equals, it is the least-squares similarity of these."""
    n = len(x0)
    neighbors = np.empty((n, min(NEIGHBOURS + 1, n)), np.int64)
    search(x0, x0, neighbors)
    u, v, p, q = vector(NEIGHBOURS + 1), vector(NEIGHBOURS + 1), vector(NEIGHBOURS + 1), vector(NEIGHBOURS + 1)
    r = vector(NEIGHBOURS + 1)
    for i in range(n):
        out[i] = math.nan
        count = 0
        for j in neighbors[i]:
            dx, dy = x0[j, 0] - x0[i, 0], x0[j, 1] - x0[i, 1]
            if dx * dx + dy * dy > 0.0:
                u[count], v[count], p[count], q[count] = dx, dy, x1[j, 0] - x1[i, 0], x1[j, 1] - x1[i, 1]
                r[count] = dx * dx + dy * dy
                count += 1
        best = MIN_AGREEING - 1
        for proposal in range(count):
            a = (u[proposal] * p[proposal] + v[proposal] * q[proposal]) / r[proposal]
            b = (u[proposal] * q[proposal] - v[proposal] * p[proposal]) / r[proposal]
            size2, agreeing, c, d, squares = a * a + b * b, 0, 0.0, 0.0, 0.0
            for k in range(count):
                ex, ey = a * u[k] - b * v[k] - p[k], b * u[k] + a * v[k] - q[k]
                reach = TOLERANCE * math.sqrt(size2 * r[k]) + NOISE_PX
                if ex * ex + ey * ey <= reach * reach:
                    agreeing += 1
                    c += u[k] * p[k] + v[k] * q[k]
                    d += u[k] * q[k] - v[k] * p[k]
                    squares += r[k]
            if agreeing > best:
                best = agreeing
                out[i, 0, 0], out[i, 0, 1] = c / squares, -d / squares
                out[i, 1, 0], out[i, 1, 1] = d / squares, c / squares


# LPM, locality preserving matching (Ma et al., IJCV 2019)


class Passes(NamedTuple):
    """Of each pass (p,) the cost up to which matches are kept, neighbours, and the agreement of motions that differ."""

    thresholds: F8x1
    neighbors: I8x1
    taus: F8x1


@kernel
def lpm_kernel(x0: F8x2, x1: F8x2, mask: B1x1, passes: Passes, out: F8x2) -> None:
    """`lpm` of x0, x1 (n, 2), mask (n,) -> out[0] (n,), 1 for matches that are kept; `lpm_cost` -> out[1]."""
    thresholds, neighbors, taus = passes
    n, m = len(mask), 0
    out[0], out[1] = 0, 1
    match, points = np.empty(n, np.int64), np.empty((2, n, 2))
    for i in range(n):
        finite = math.isfinite(x0[i, 0]) and math.isfinite(x0[i, 1])
        match[m] = i
        for k in range(2):
            points[0, m, k], points[1, m, k] = x0[i, k], x1[i, k]
        m += mask[i] and finite and math.isfinite(x1[i, 0]) and math.isfinite(x1[i, 1])
    points0, points1 = points[0, :m], points[1, :m]
    members, cost, total, done = np.arange(m), vector(m), np.zeros(m), 0
    for k in range(len(thresholds)):
        if done > 0 and len(members) < neighbors[k] + 4:
            continue
        _cost(points0, points1, members, neighbors[k], taus[k], cost)
        done += 1
        total += cost
        kept = 0
        members = np.empty(m, np.int64)
        for i in range(m):
            members[kept] = i
            kept += cost[i] <= thresholds[k]
        members = members[:kept]
    for i in range(m):
        out[0, match[i]] = cost[i] <= thresholds[done - 1]
        out[1, match[i]] = total[i] / done


@inner
def _cost(points0: Array, points1: Array, members: Array, K: int, tau: float, cost: Array) -> None:
    """The mean over the three neighbourhood sizes -> cost (n,); the neighbours are among the members."""
    n, width = len(points0), K + 3
    near0, near1 = np.empty((n, width), np.int64), np.empty((n, width), np.int64)
    search(points0, points0[members], near0)
    search(points1, points1[members], near1)
    for i in range(n):
        cost[i] = 0
        for scale in range(3):  # as released: neighbours 1..K+2, 2..K+1, 3..K; 0 is the match
            size = K + 2 - 2 * scale
            kept = 0
            for a in range(1 + scale, width - scale):
                place = 0
                for b in range(width):
                    if near0[i, a] == near1[i, b] and near0[i, a] >= 0:
                        place = b
                if scale < place < width - scale:
                    kept += not _differs(points0, points1, i, members[near0[i, a]], tau)
            cost[i] += (size - kept) / size
        cost[i] /= 3


@inner
def _differs(points0: Array, points1: Array, i: int, j: int, tau: float) -> Any:
    """Whether matches i and j move differently; never where one of the two does not move."""
    x, y = points1[i, 0] - points0[i, 0], points1[i, 1] - points0[i, 1]
    u, v = points1[j, 0] - points0[j, 0], points1[j, 1] - points0[j, 1]
    length, other = x * x + y * y, u * u + v * v
    cosine = (x * u + y * v) / math.sqrt(length * other)
    return cosine * min(length, other) / max(length, other) < tau


def lpm(
    x0: Float[Tensor, "b n 2"], x1: Float[Tensor, "b n 2"],
    *, mask: Bool[Tensor, "b n"] | None = None, thresholds: Sequence[float] = (0.8, 0.5),
    neighbors: Sequence[int] = (6, 6), taus: Sequence[float] = (0.2, 0.2),
) -> Bool[Tensor, "b n"]:  # fmt: skip
    """True for matches whose neighbourhoods in the two images hold the same matches, moving alike.
    The cost of a match is the mean over three neighbourhood sizes (K + 2, K, K - 2) of the share of its neighbours that
    are near in one image only or whose motion differs, ``cos(angle) * ratio of squared lengths < tau``. Two passes,
    each with its threshold lambda, K and tau: the second seeks neighbours among the matches that the first kept, if
    those are at least K + 4, and decides. Equal to the released code with exact neighbours, ties by index; a neighbour
    that does not exist, where matches are few, counts as lost.
    Points in any common unit; not finite ones drop. Linear memory, CPU. ValueError for K < 4 and unequal options."""
    return _kept_and_cost(x0, x1, mask, _passes(thresholds, neighbors, taus))[:, 0] > 0


def lpm_cost(
    x0: Float[Tensor, "b n 2"], x1: Float[Tensor, "b n 2"],
    *, mask: Bool[Tensor, "b n"] | None = None, thresholds: Sequence[float] = (0.8, 0.5),
    neighbors: Sequence[int] = (6, 6), taus: Sequence[float] = (0.2, 0.2),
) -> Float[Tensor, "b n"]:  # fmt: skip
    """The mean of the costs of the passes of `lpm`, in [0, 1]; 1 for masked matches and non-finite points.
    The second pass sees what the first kept: together they tell right from wrong best. Arguments as `lpm`."""
    return _kept_and_cost(x0, x1, mask, _passes(thresholds, neighbors, taus))[:, 1].to(x0.dtype)


def _kept_and_cost(x0: Tensor, x1: Tensor, mask: Tensor | None, passes: Passes) -> Float[Tensor, "b 2 n"]:
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    out = torch.empty(len(x0), 2, x0.shape[1], dtype=torch.float64)
    return for_each_pair(lpm_kernel, (x0, x1, mask), passes, out=out, kind=torch.float64)


def _passes(thresholds: Sequence[float], neighbors: Sequence[int], taus: Sequence[float]) -> Passes:
    """The options by pass; raises ValueError where they do not belong together."""
    counts = {"thresholds": len(thresholds), "neighbors": len(neighbors), "taus": len(taus)}
    if len(set(counts.values())) > 1 or not thresholds:
        said = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise ValueError(f"{said} values; they must have one for each pass, and there must be a pass")
    if min(neighbors) < 4:
        raise ValueError(f"neighbors is {neighbors}; each must be at least 4, so that the smallest neighbourhood has 2")
    return Passes(np.array(thresholds, float), np.array(neighbors, np.int64), np.array(taus, float))


class LPM:
    """`lpm` as a stage; or, `soft`, a stage that keeps every match and supplies ``prior``: P(inlier) by `lpm_cost`.
    `thresholds`, `neighbors`, `taus` hold one value for each of the two passes. calibration: of one minus the cost, see
    `Calibration`; needed by the soft form alone, which raises ValueError without it."""

    def __init__(
        self, *, thresholds: Sequence[float] = (0.8, 0.5), neighbors: Sequence[int] = (6, 6),
        taus: Sequence[float] = (0.2, 0.2), soft: bool = False,
        calibration: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:  # fmt: skip
        self._options: dict[str, Any] = {"thresholds": thresholds, "neighbors": neighbors, "taus": taus}
        self.calibration = calibration_of("LPM", soft, calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that keep their neighbourhoods, or with a prior."""
        if self.calibration is not None:
            return self.calibration(c, self.evidence(c))
        return c.keep(lpm(c.x0, c.x1, mask=c.mask, **self._options))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from: one minus the cost."""
        return 1 - lpm_cost(c.x0, c.x1, mask=c.mask, **self._options)


# Orders along space-filling curves

_BITS = 15  # of each coordinate: a code of 30 bits
_CELLS = (1 << _BITS) - 1
_DIGIT = 10  # bits sorted by at a time
_PLACES = 1 << _DIGIT
CURVES = ((0.0, 0.0), (0.5, math.pi / 4))  # shift of the grid (in thirds of the extent) and rotation of each curve
CURVES32 = np.array([(shift, math.cos(angle), math.sin(angle)) for shift, angle in CURVES], np.float32)


@inner
def curve_order(x: Array, y: Array, shift: float, cosine: float, sine: float, order: Array) -> None:
    """The order of points x, y (n,) along a curve -> order (n,) i8.
    shift, cosine, sine: of the grid and of the rotation, in the type of the points."""
    n = len(x)
    if n == 0:
        return
    u, v = np.empty_like(x), np.empty_like(y)
    for i in range(n):
        u[i] = cosine * x[i] - sine * y[i]
        v[i] = sine * x[i] + cosine * y[i]
    low_u, high_u, low_v, high_v = u[0], u[0], v[0], v[0]
    for i in range(n):
        low_u, high_u = min(low_u, u[i]), max(high_u, u[i])
        low_v, high_v = min(low_v, v[i]), max(high_v, v[i])
    kind = x.dtype.type
    extent = max(max(high_u - low_u, high_v - low_v), kind(1e-6))
    two, three, cells = kind(2), kind(3), kind(_CELLS)  # of the points' type, or the products would be float64
    key, sorted_key = np.empty(n, np.uint64), np.empty(n, np.uint64)
    for i in range(n):
        column = np.int64(((u[i] - low_u) / extent * two + shift) / three * cells)
        row = np.int64(((v[i] - low_v) / extent * two + shift) / three * cells)
        key[i] = ((_spread(column) | (_spread(row) << np.uint64(1))) << np.uint64(32)) | np.uint64(i)
    for digit in range(3):
        _sort_by_digit(key, sorted_key, np.uint64(32 + _DIGIT * digit))
        key, sorted_key = sorted_key, key
    for i in range(n):
        order[i] = np.int64(key[i] & np.uint64(0xFFFFFFFF))


@inner
def _spread(cell: Any) -> Any:
    """The 15 bits of a cell's number moved to the even positions."""
    v = np.uint64(cell) & np.uint64(_CELLS)
    v = (v | (v << np.uint64(8))) & np.uint64(0x00FF00FF)
    v = (v | (v << np.uint64(4))) & np.uint64(0x0F0F0F0F)
    v = (v | (v << np.uint64(2))) & np.uint64(0x33333333)
    return (v | (v << np.uint64(1))) & np.uint64(0x55555555)


@inner
def _sort_by_digit(key: Array, out: Array, low: Any) -> None:
    """Keys (n,) in the order of the ten bits from bit `low` on, equal ones as they stood -> out (n,)."""
    place = np.zeros(_PLACES + 1, np.int64)
    for i in range(len(key)):
        place[((key[i] >> low) & np.uint64(_PLACES - 1)) + np.uint64(1)] += 1
    for digit in range(_PLACES):
        place[digit + 1] += place[digit]
    for i in range(len(key)):
        digit = (key[i] >> low) & np.uint64(_PLACES - 1)
        out[place[digit]] = key[i]
        place[digit] += 1


@inner
def curve_orders(rows: Array, orders: Array) -> None:
    """The order of matches (x0, y0, x1, y1, ...) along each curve, first of image 0, then of image 1 -> (c, m)."""
    m = orders.shape[1]
    for o in range(len(orders)):
        image, curve = o // len(CURVES32), o % len(CURVES32)
        curve_order(
            rows[2 * image, :m], rows[2 * image + 1, :m], CURVES32[curve, 0], CURVES32[curve, 1], CURVES32[curve, 2],
            orders[o],
        )  # fmt: skip


@inner
def put_in_order(rows: Array, order: Array, along: Array) -> None:
    """Columns of rows (d, n) in the order (m,) -> along (d, m)."""
    for k in range(len(rows)):
        for i in range(len(order)):
            along[k, i] = rows[k, order[i]]
