"""Exact nearest neighbours in the plane, compiled: a balanced k-d tree whose nodes are known by arithmetic."""

import math
from typing import Any

import numpy as np

from fmtorch.geometry.arithmetic import smallest_but
from fmtorch.jit.kernel import Array, F8x2, F8x3, inner, kernel, matrix, vector

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
