"""Robust losses, and Levenberg-Marquardt: the loop of non-linear fits, over the models of one pair.

Losses grow more slowly than the squared residual. Each is scaled so that ``loss ~ r^2`` for small residuals;
``weight = d loss / d r^2`` is then 1 at zero, and minimising ``sum weight * r^2`` with the weights held fixed, again
and again, minimises the sum of losses (IRLS). `r2` is the squared residual, `s2` the squared scale in the same unit;
both broadcast. Zhang (1997), "Parameter estimation techniques", table 1; Torr & Zisserman (2000) for the truncated one;
Barath et al. (2020) for that of MAGSAC++, whose scale is k sigma_max, the distance from which on nothing counts.

Damped Gauss-Newton steps; each model takes its own where that lowers its cost, and else tries a shorter one (Marquardt
1963; Hartley & Zisserman 2004, appendix 6.2). The objective is a set of inner functions, so that a whole fit is one
call, between whose steps nothing waits for Python."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from fmtorch.geometry.arithmetic import logarithm_1p_kernel
from fmtorch.geometry.arithmetic import sqrt as exact_sqrt
from fmtorch.geometry.epipolar import TINY
from fmtorch.jit.kernel import Array, F8x1, F8x2, F8x3, Inner, inner, kernel, matrix
from fmtorch.jit.lanes import LANES, added, fill, load, sqrt, store, where

QUANTILE = 3.64
ENTRIES = 2048  # intervals of u in [0, 1] between which the tabulated weight is linear: off by at most 3e-5
TERMS = 40  # of series in x up to QUANTILE^2 / 2: what is left out is below a rounding error
END = np.array([QUANTILE**2 / 2])


def marginal_loss(u: Array) -> Array:
    """rho / sigma_max^2, for u in [0, 1]."""
    x = u * END
    return np.asarray(_lower_gamma(2.5, x) / 2 + x / 2 * (_lower_gamma(1.5, END) - _lower_gamma(1.5, x)))


def _lower_gamma(s: float, x: Array) -> Array:
    """The lower incomplete gamma function of s, 3/2 or 5/2, of x from 0 to about 7.
    ``x^s exp(-x) sum_n x^n / (s (s + 1) ... (s + n))``, and exp by its series, too: sums of positive terms, by
    arithmetic alone, so that tables made of it are the same on every processor."""
    total, exponential = np.zeros_like(x), np.ones_like(x)
    for n in range(TERMS, -1, -1):
        total = (total * x + 1) / (s + n)
        exponential = exponential * x / (n + 1) + 1
    power = x * np.sqrt(x) if s == 1.5 else x * x * np.sqrt(x)
    return power * total / exponential


_u = np.arange(ENTRIES + 1) / ENTRIES
_weight = np.append(1 - _lower_gamma(1.5, _u * END) / _lower_gamma(1.5, END), 0.0)  # the slope over that at zero
_integral = np.append(0.0, np.cumsum((_weight[:-1] + _weight[1:]) / (2 * ENTRIES)))
LOSS_TABLE = np.stack([_weight, _integral])
"""The weight at the ends of the intervals, zero beyond u = 1, and its integral up to each of them, (2, ENTRIES + 2)."""
_gain = 1 - marginal_loss((np.arange(ENTRIES) + 0.5) / ENTRIES) / marginal_loss(np.ones(1))
GAIN_TABLE = np.append(_gain, 0.0).astype(np.float32)
"""1 - rho / rho_max in the middle of each interval, and 0 from u = 1 on, (ENTRIES + 1,) float32."""

_WEIGHT = torch.from_numpy(LOSS_TABLE[0])


class RobustLoss(NamedTuple):
    """The derivative of a robust loss with respect to r^2, and its curvature, both functions of (r2, s2).
    curvature: half the second derivative with respect to r, ``rho' + 2 r^2 rho''``, and 0 where that is negative."""

    weight: Callable[[Tensor, Tensor], Tensor]
    curvature: Callable[[Tensor, Tensor], Tensor]


def huber_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """1 up to the scale s, ``s / |r|`` beyond (Huber 1964)."""
    return exact_sqrt(s2 / torch.maximum(r2, s2))


def within_scale(r2: Tensor, s2: Tensor) -> Tensor:
    """1 up to the scale, 0 beyond: the curvature of Huber's loss, and both derivatives of the truncated one,
    ``min(r^2, s^2)``: MSAC. An infinite scale gives plain least squares."""
    return (r2 <= s2).to(r2.dtype)


def cauchy_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^2 / (s^2 + r^2)``."""
    return s2 / (s2 + r2)


def cauchy_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^2 (s^2 - r^2) / (s^2 + r^2)^2``, or 0."""
    return s2 / (s2 + r2) * ((s2 - r2) / (s2 + r2)).clamp_min(0)


def geman_mcclure_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^4 / (s^2 + r^2)^2``."""
    return (s2 / (s2 + r2)).square()


def geman_mcclure_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """``s^4 (s^2 - 3 r^2) / (s^2 + r^2)^3``, or 0."""
    return geman_mcclure_weight(r2, s2) * ((s2 - 3 * r2) / (s2 + r2)).clamp_min(0)


def tabulated_weight(r2: Tensor, s2: Tensor) -> Tensor:
    """That of MAGSAC++ over its slope at zero, from the table: 1 at zero, 0 from s = k sigma_max on."""
    _, share, weight, step = _look_up(r2, s2)
    return (weight + share * step).to(r2.dtype)


def tabulated_curvature(r2: Tensor, s2: Tensor) -> Tensor:
    """Half the second derivative of the tabulated loss by r, or 0 where that is negative."""
    interval, share, weight, step = _look_up(r2, s2)
    slope = 2 * (interval + share) * step  # 2 r^2 rho''; intervals are of length 1 / ENTRIES
    return (weight + share * step + slope).clamp_min(0).to(r2.dtype)


def _look_up(r2: Tensor, s2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The interval of u, the share of it that lies below u, the weight at its beginning, and how much that rises."""
    position = (r2 / s2 * ENTRIES).clamp(0, ENTRIES).to(torch.float64)
    interval = position.nan_to_num(nan=0).to(torch.int64)  # what is NaN stays so by its share
    table = _WEIGHT.to(r2.device)
    weight = torch.take(table, interval)
    return interval, position - interval, weight, torch.take(table, interval + 1) - weight


LOSSES: dict[str, RobustLoss] = {
    "huber": RobustLoss(huber_weight, within_scale),
    "cauchy": RobustLoss(cauchy_weight, cauchy_curvature),
    "geman_mcclure": RobustLoss(geman_mcclure_weight, geman_mcclure_curvature),
    "truncated": RobustLoss(within_scale, within_scale),
    "magsac": RobustLoss(tabulated_weight, tabulated_curvature),
}


def named_loss(name: str) -> RobustLoss:
    """The loss of that name; a ValueError that lists the names where there is none."""
    if name not in LOSSES:
        raise ValueError(f"loss is {name!r}; it must be one of: {', '.join(LOSSES)}")
    return LOSSES[name]


# Robust errors of one pair, compiled, and the loop that minimises them

LOSS_CODES = {name: code for code, name in enumerate(LOSSES)}
HUBER, CAUCHY, GEMAN_MCCLURE, TRUNCATED, MAGSAC = LOSS_CODES.values()
NO_TABLE = np.empty((2, 0))
MATCH = 6  # rows of LANES matches: x0, y0, x1, y1, their weights, squared scales


class Weighted(NamedTuple):
    """Matches and a robust loss of their errors.
    points: (4, n). weight: (n,), what each counts. s2: (n,), squared scales of the loss, a code. table: (2, t + 2), of
    the loss MAGSAC, its weight at the ends of t intervals of r^2 / s^2 and beyond, and the weight's integral up to
    there; of others it is not read."""

    points: F8x2
    weight: F8x1
    s2: F8x1
    loss: int
    table: F8x2

    @staticmethod
    def of(points: Array, weight: Array, s2: Array, loss: str = "truncated") -> "Weighted":
        """Matches with the loss of this name."""
        return Weighted(points, weight, s2, LOSS_CODES[loss], LOSS_TABLE if loss == "magsac" else NO_TABLE)


BLOCK = 16  # times LANES matches, whose derivatives stand in the nearest cache


class Rows(NamedTuple):
    """`in_rows` of matches, their loss, and room for sums (size size, LANES), derivatives and these weighted."""

    matches: F8x2
    loss: int
    table: F8x2
    sums: F8x2
    J: F8x2
    scaled: F8x2
    work: F8x2


@inner
def rows_of(weighted: Weighted, size: int) -> Rows:
    """The matches for a sum over derivatives and residual, together of this size, an even number."""
    matches = in_rows(weighted.points, weighted.weight, weighted.s2)
    sums, J, scaled = matrix(size * size, LANES), matrix(size * BLOCK, LANES), matrix(size * BLOCK, LANES)
    return Rows(matches, weighted.loss, weighted.table, sums, J, scaled, matrix(3, LANES))


def summation(linearise: Inner[..., Any], size: int) -> Inner[..., Any]:
    """summed(model, rows, derivatives, products): the robust cost of a model, and if asked the weighted products of
    derivatives and residual (size, size). linearise(model, matches, row, J, at): those of LANES matches -> J from row
    `at` on; inverse squared slopes and squared distances."""

    @inner
    def summed(model: Any, rows: Rows, derivatives: bool, products: Array) -> Any:
        matches, loss, table, sums, J, scaled, work = rows
        costs = fill(0.0)
        for q in range(len(sums) if derivatives else 0):
            store(sums, q, costs)
        for first in range(0, len(matches), MATCH * BLOCK):
            count = min((len(matches) - first) // MATCH, BLOCK)
            for b in range(count):
                row, at = first + b * MATCH, b * size
                inverse, r2 = linearise(model, matches, row, J, at)
                share, slope = robust(r2, load(matches, row + 5), loss, table, work)
                costs += share * load(matches, row + 4)
                if derivatives:
                    factor = inverse * (load(matches, row + 4) * slope)
                    for r in range(size):
                        store(scaled, at + r, load(J, at + r) * factor)
            if derivatives:
                add_products(J, scaled, count, size, sums)
        if derivatives:
            assemble(sums, products)
        return added(costs)

    return summed


@kernel
def evaluate(F: F8x2, weighted: Weighted, derivatives: bool, products: F8x3, cost: F8x1) -> None:
    """Robust weighted cost (k,) of models (k, 9) by Sampson distances; with derivatives also products (k, 10, 10)."""
    rows = rows_of(weighted, 10)
    for k in range(len(F)):
        cost[k] = _summed(F[k], rows, derivatives, products[k])


@inner
def in_rows(points: Array, weight: Array, s2: Array) -> Array:
    """Matches (n,), LANES in MATCH rows each; those that fill the last ones have no weight."""
    n = len(weight)
    rows = np.zeros((MATCH * ((n + LANES - 1) // LANES), LANES))
    for first in range(0, n, LANES):
        row = first // LANES * MATCH
        for i in range(LANES):
            rows[row + 5, i] = 1.0
        for i in range(min(LANES, n - first)):
            for k in range(4):
                rows[row + k, i] = points[k, first + i]
            rows[row + 4, i], rows[row + 5, i] = weight[first + i], s2[first + i]
    return rows


@inner
def linearise_kernel(f: Array, matches: Array, row: int, J: Array, at: int) -> tuple[Any, Any]:
    """Jacobian and residual of LANES matches -> ten rows of J; inverse squared slopes, squared Sampson distances."""
    x0, y0, x1, y1 = load(matches, row), load(matches, row + 1), load(matches, row + 2), load(matches, row + 3)
    a0, b0 = f[0] * x0 + f[1] * y0 + f[2], f[3] * x0 + f[4] * y0 + f[5]
    a1, b1 = f[0] * x1 + f[3] * y1 + f[6], f[1] * x1 + f[4] * y1 + f[7]
    e = f[6] * x0 + f[7] * y0 + f[8] + a0 * x1 + b0 * y1
    slope = a0 * a0 + b0 * b0 + a1 * a1 + b1 * b1
    inverse = 1.0 / where(slope > TINY, slope, TINY)
    c = e * inverse
    u, v, p, q = x1 - c * a0, y1 - c * b0, -c * a1, -c * b1
    store(J, at, (u * x0 + x1 * p, u * y0 + x1 * q, u, v * x0 + y1 * p, v * y0 + y1 * q, v))
    store(J, at + 6, (x0 + p, y0 + q, fill(1.0), e))
    return inverse, e * c


_summed = summation(linearise_kernel, 10)


@inner
def robust(r2: Any, s2: Any, loss: int, table: Array, work: Array) -> tuple[Any, Any]:
    """The losses of squared residuals, and their derivatives by these. work: (3, LANES)."""
    if loss == TRUNCATED:
        value, slope = where(r2 <= s2, r2, s2), where(r2 <= s2, fill(1.0), 0.0)
    elif loss == GEMAN_MCCLURE:
        share = s2 / (s2 + r2)
        value, slope = r2 * share, share * share
    elif loss == HUBER:
        far = where(r2 > s2, r2, s2)
        value, slope = where(r2 <= s2, r2, 2.0 * sqrt(s2 * far) - s2), sqrt(s2 / far)
    elif loss == CAUCHY:
        store(work, 0, r2 / s2)
        for i in range(LANES):
            work[0, i] = logarithm_1p_kernel(work[0, i])
        value, slope = s2 * load(work, 0), s2 / (s2 + r2)
    else:
        store(work, 0, r2 / s2)
        _tabulated(table, work)
        value, slope = s2 * load(work, 1), load(work, 2)
    # A residual that is not a number must not pass for a small loss.
    return where(r2 == r2, value, math.nan), slope


@inner
def _tabulated(table: Array, work: Array) -> None:
    """Integral and value of the table at r^2 / s^2, in row 0 of work (3, LANES) -> its rows 1 and 2."""
    entries = table.shape[1] - 2
    for i in range(LANES):
        position = work[0, i] * entries
        position = position if position < entries else float(entries)
        interval = min(max(np.int64(position), 0), entries)
        share, begin = position - interval, table[0, interval]
        rise = table[0, interval + 1] - begin
        work[1, i] = table[1, interval] + (begin + share * rise / 2) * share / entries
        work[2, i] = begin + share * rise


@inner
def add_products(J: Array, weighted: Array, count: int, size: int, sums: Array) -> None:
    """Adds the products of Jacobian and residual, which have a size, an even number of rows, for each LANES matches.
    sums: (size size, LANES), of which the upper triangle is not used; two by two, so that four are in registers."""
    for r in range(0, size, 2):
        for c in range(0, r + 1, 2):
            q = r * size + c
            s00, s01, s10, s11 = load(sums, q), load(sums, q + 1), load(sums, q + size), load(sums, q + size + 1)
            for row in range(0, count * size, size):
                a, b = load(J, row + r), load(J, row + r + 1)
                d, e = load(weighted, row + c), load(weighted, row + c + 1)
                s00, s01, s10, s11 = s00 + a * d, s01 + a * e, s10 + b * d, s11 + b * e
            store(sums, q, (s00, s01))
            store(sums, q + size, (s10, s11))


@inner
def assemble(sums: Array, products: Array) -> None:
    """The sums of `add_products` -> products, both triangles."""
    for r in range(len(products)):
        for c in range(r + 1):
            total = added(load(sums, r * len(products) + c))
            products[r, c], products[c, r] = total, total


SQUARINGS = 5  # enough for any matrix whose last two singular values differ by half
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-4, 1e-12, 1e6  # relative to the greatest curvature


class Schedule(NamedTuple):
    """iterations: steps at most. damping: of the first. tolerance: a model is done once a step has lowered its cost by
    no more than this share of it; 0: none is ever done. squarings: of the start of a fundamental matrix (`start_one`).
    """

    iterations: int
    damping: float = FIRST_DAMPING
    tolerance: float = 0.0
    squarings: int = SQUARINGS


def minimiser(
    evaluate: Callable[..., None], step: Callable[..., None], take: Callable[..., None],
    relative: bool = True, min_damping: float = MIN_DAMPING,
) -> Callable[[Any, Any, Any, Array, int, float], None]:  # fmt: skip
    """The loop for an objective: loop(data, state, trial, damping, iterations, tolerance), in place.
    evaluate(state, data, derivatives): the costs, and the derivatives if asked for, at the state's parameters.
    step(data, state, damping, trial): those of a trial. take(state, trial, k): gives the state model k of the trial but
    for its cost, where that is lower: such a step divides the damping by 10, another multiplies it. relative: whether
    the tolerance is a share of the cost, as of `Schedule`, or a number, of which a negative one ends nothing."""

    @inner
    def accept(state: Any, trial: Any, damping: Array, done: Array, tolerance: float, ends: bool) -> bool:
        """The trial for the models that it improves; whether all are done."""
        everything = True
        for k in range(len(damping)):
            better = trial.cost[k] < state.cost[k] and not done[k]
            damping[k] = min(max(damping[k] / 10 if better else damping[k] * 10, min_damping), MAX_DAMPING)
            if better:
                needed = tolerance * state.cost[k] if relative else tolerance
                done[k] |= ends and state.cost[k] - trial.cost[k] <= needed
                state.cost[k] = trial.cost[k]
                take(state, trial, k)
            everything = everything and done[k]
        return everything

    @inner
    def loop(data: Any, state: Any, trial: Any, damping: Array, iterations: int, tolerance: float) -> None:
        """The state holds the start, then that of least cost; no cost ever rises.
        damping: (k,), the first of each model. tolerance: what a step must lower the cost of a model by, if it is not
        to be done; where models are ever done the state keeps the derivatives at the end."""
        done = np.zeros(len(damping), np.bool_)
        ends = tolerance > 0 if relative else tolerance >= 0
        evaluate(state, data, iterations > 0 or ends)
        for i in range(iterations):
            step(data, state, damping, trial)
            evaluate(trial, data, i + 1 < iterations or ends)
            if accept(state, trial, damping, done, tolerance, ends) and ends:
                break

    return loop
