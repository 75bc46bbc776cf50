"""`degeneracy` for one model, compiled: the plane of its sample, its matches, and models of two matches off it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.compiling.kernel import kernel
from fmtorch.compiling.random_kernels import random_bits, stream_state
from fmtorch.geometry.homography_kernels import (
    least_squares_homography,
    near_plane,
    plane_and_parallax,
    plane_homography,
)
from fmtorch.geometry.rank2_kernels import assign, last_right_singular_vector

Array = NDArray[Any]


@kernel("f8[::1], f8[:, ::1], i8[:, ::1], f8, f8[::1]")
def plane_of_sample(F: Array, sample: Array, triplets: Array, limit: float, H: Array) -> int:
    """The homography that is compatible with F and has most matches of its sample -> H (9,); how many these are.

    sample: (4, 7), points. triplets: (t, 3), of the sample, through each of which one homography goes. limit: of
    squared transfer distances. Of equals the first is taken; without any H is zero.
    """
    G, Ft, e1 = np.empty(9), np.empty(9), np.empty(3)
    near, most = np.empty(sample.shape[1], np.bool_), 0
    for i in range(9):
        Ft[i], H[i] = F[3 * (i % 3) + i // 3], 0.0
    last_right_singular_vector(Ft, e1)
    for t in range(len(triplets)):
        if plane_homography(F, e1, sample, triplets[t], G):
            members = near_plane(G, sample, limit, near)
            if members > most:
                most = members
                assign(H, G)
    return most


@kernel("f8[::1], f8[:, ::1], f8, i8, b1[::1]")
def fit_plane(H: Array, points: Array, limit: float, fits: int, inside: Array) -> None:
    """H (9,), in place, fitted to the matches near it as long as these become more; those matches -> inside (n,)."""
    G, others = np.empty(9), np.empty(len(inside), np.bool_)
    count = near_plane(H, points, limit, inside)
    for _ in range(fits):
        if not least_squares_homography(points, inside, G):
            break
        more = near_plane(G, points, limit, others)
        if more <= count:
            break
        count = more
        assign(H, G)
        for i in range(len(inside)):
            inside[i] = others[i]


@kernel("f8[::1], f8[:, ::1], i8[::1], i8, i8, i8, f4[:, ::1]")
def parallax(H: Array, points: Array, table: Array, mixed_seed: int, key: int, start: int, out: Array) -> int:
    """Models of a plane and two matches off it -> out (draws, 9); how many there are.

    table: cumulative weights (n,), below 2^31, by which matches are drawn, with replacement, by the numbers from
    `start` on, two a draw. mixed_seed: of the seed and the stream.
    """
    state, total = stream_state(mixed_seed, key), np.uint64(table[-1])
    F, pair, models = np.empty(9), np.empty(2, np.int64), 0
    for draw in range(len(out)):
        for k in range(2):
            word = random_bits(state, start + 2 * draw + k) >> np.uint64(31)
            pair[k] = np.searchsorted(table, np.int64(word * total >> np.uint64(32)), side="right")
        if plane_and_parallax(H, points, pair[0], pair[1], F):
            for i in range(9):
                out[models, i] = F[i]
            models += 1
    return models
