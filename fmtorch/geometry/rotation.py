"""The homography of a camera that turns, ``H = K1 R K0^-1``, fitted to the matches of one pair, compiled."""

import math
from typing import NamedTuple

import numpy as np

from fmtorch.geometry.arithmetic import exponential
from fmtorch.geometry.homography import in_pixels
from fmtorch.geometry.homography_refine import evaluate_homographies
from fmtorch.geometry.levenberg_marquardt import GEMAN_MCCLURE, Weighted
from fmtorch.geometry.matrices import assign, invert, multiply, orthogonal_factor
from fmtorch.geometry.rank2_manifold import eliminate
from fmtorch.jit.kernel import Array, F8x2, inner, matrix, vector
from fmtorch.jit.lanes import LANES

PARAMETERS = 5  # three of the rotation, the logarithms of two focal lengths
LOSS = 3.0  # noises; scale of the loss
STEPS = 12
DAMPING, MAX_DAMPING = 1e-6, 1e6
TOLERANCE = 1e-4  # nats that a step must gain


class Cameras(NamedTuple):
    """K0, K1 (3, 3), zero where unknown; precision (2, 2) of the logarithms of their focal lengths, infinite: known."""

    K0: F8x2
    K1: F8x2
    precision: F8x2


class _Turn(NamedTuple):
    """R (9,), the logarithms of two focal lengths over those of the calibration matrices (2,), K1 R K0^-1 (1, 9)."""

    R: Array
    focal: Array
    H: Array


@inner
def fit_rotation(
    points: Array, noise: Array, H: Array, cameras: Cameras, s: float, parameters: Array, fitted: Array
) -> float:
    """R and focal lengths of least robust cost -> parameters (11,): logarithms, R; K1 R K0^-1 -> fitted (9,).
    Starts at the rotation nearest to K1^-1 H K0. points (4, n) and s in pixels. Returns the cost of the prior, infinite
    where a calibration is singular."""
    n, unit_px = len(noise), math.sqrt(abs(cameras.K0[0, 0] * cameras.K1[0, 0]))
    A0, A1, back = vector(9), vector(9), vector(9)
    _centred(cameras.K1, unit_px, A1)
    turn = _Turn(vector(9), np.zeros(2), matrix(1, 9))
    if not (unit_px > 0 and invert(cameras.K1.ravel(), A0)):
        return math.inf
    multiply(A0, H, back)
    multiply(back, cameras.K0.ravel(), turn.R)
    _centred(cameras.K0, unit_px, A0)
    if not (orthogonal_factor(turn.R) and invert(A0, back)):
        return math.inf
    x, weight, s2, unit_s = matrix(4, n), vector(n), vector(n), s / unit_px
    for i in range(n):
        for image in range(2):
            K = cameras.K0 if image == 0 else cameras.K1
            x[2 * image, i] = (points[2 * image, i] - K[0, 2]) / unit_px
            x[2 * image + 1, i] = (points[2 * image + 1, i] - K[1, 2]) / unit_px
        weight[i] = 1 / (noise[i] * noise[i])
        s2[i] = (LOSS * unit_s * noise[i]) * (LOSS * unit_s * noise[i])
    matches = Weighted(x, weight, s2, GEMAN_MCCLURE, matrix(2, 0))
    prior, free = np.zeros((2, 2)), np.zeros(2)
    for a in range(2):
        free[a] = cameras.precision[a, a] < math.inf
    for a in range(2):
        for b in range(2):
            prior[a, b] = cameras.precision[a, b] if free[a] * free[b] > 0 else 0.0
    _minimise(turn, A1, back, matches, unit_s, prior, free)
    assign(parameters[:2], turn.focal)
    assign(parameters[2:], turn.R)
    centre = np.array([cameras.K0[0, 2], cameras.K0[1, 2], cameras.K1[0, 2], cameras.K1[1, 2]])
    in_pixels(turn.H[0], centre, unit_px, fitted)
    return _cost(turn.focal, prior)


@inner
def _minimise(turn: _Turn, A1: Array, back: Array, matches: Weighted, s: float, prior: Array, free: Array) -> None:
    """Levenberg and Marquardt's steps from a turn, in place. free (2,): 1 for a focal length that is not known."""
    trial = _Turn(vector(9), vector(2), matrix(1, 9))
    T, products, cost, step = matrix(9, PARAMETERS), np.empty((1, 10, 10)), vector(1), vector(PARAMETERS)
    _model(turn, A1, back, free, T)
    evaluate_homographies(turn.H, matches, True, products, cost)
    best, damping = cost[0] / (2 * s * s) + _cost(turn.focal, prior), DAMPING
    for _ in range(STEPS):
        _step(products[0], T, turn.focal, s, prior, free, damping, step)
        _moved(turn, step, trial)
        _model(trial, A1, back, free, T)
        evaluate_homographies(trial.H, matches, True, products, cost)
        value = cost[0] / (2 * s * s) + _cost(trial.focal, prior)
        gain = best - value
        if gain > 0:
            damping, best = damping / 10, value
            assign(turn.R, trial.R)
            assign(turn.focal, trial.focal)
            assign(turn.H[0], trial.H[0])
            if gain < TOLERANCE:
                break
        else:
            damping *= 100
            if not damping < MAX_DAMPING or abs(gain) < TOLERANCE:
                break
            _model(turn, A1, back, free, T)
            evaluate_homographies(turn.H, matches, True, products, cost)


@inner
def _step(
    products: Array, T: Array, focal: Array, s: float, prior: Array, free: Array, damping: float, out: Array
) -> None:
    """The damped Gauss-Newton step (5,): ``(T^T P T / s^2 + prior) step = -gradient``."""
    M = np.zeros((PARAMETERS, LANES))
    for a in range(PARAMETERS):
        for b in range(PARAMETERS + 1):
            total = 0.0
            for i in range(9):
                if b == PARAMETERS:
                    total -= T[i, a] * products[i, 9]
                else:
                    for k in range(9):
                        total += T[i, a] * products[i, k] * T[k, b]
            M[a, b] = total / (s * s)
    for a in range(2):
        for b in range(2):
            M[3 + a, 3 + b] += prior[a, b]
            M[3 + a, PARAMETERS] -= prior[a, b] * focal[b]
        M[3 + a, 3 + a] += 1 - free[a]
    for a in range(PARAMETERS):
        M[a, a] += damping * M[a, a] + 1e-300
    eliminate(M, PARAMETERS)
    for a in range(PARAMETERS):
        out[a] = M[a, PARAMETERS]


@inner
def _cost(focal: Array, prior: Array) -> float:
    """Half the squared deviation of the logarithms of the focal lengths."""
    total = 0.0
    for a in range(2):
        for b in range(2):
            total += focal[a] * prior[a, b] * focal[b] / 2
    return total


@inner
def _moved(turn: _Turn, step: Array, out: _Turn) -> None:
    """``R(step) R`` by Cayley's map, and the focal lengths with their steps -> out."""
    x, y, z = step[0] / 2, step[1] / 2, step[2] / 2
    by, X = 2 / (1 + x * x + y * y + z * z), vector(9)
    X[0], X[1], X[2] = 1 - by * (y * y + z * z), by * (x * y - z), by * (x * z + y)
    X[3], X[4], X[5] = by * (x * y + z), 1 - by * (x * x + z * z), by * (y * z - x)
    X[6], X[7], X[8] = by * (x * z - y), by * (y * z + x), 1 - by * (x * x + y * y)
    multiply(X, turn.R, out.R)
    out.focal[0], out.focal[1] = turn.focal[0] + step[3], turn.focal[1] + step[4]


@inner
def _model(turn: _Turn, A1: Array, back: Array, free: Array, T: Array) -> None:
    """H = A1 E1 R E0^-1 back -> turn.H, E = diag(e, e, 1) with e = exp(focal); its derivatives -> T (9, 5)."""
    left, right, X, Y = vector(9), vector(9), vector(9), vector(9)
    e0, e1 = exponential(turn.focal[0]), exponential(turn.focal[1])
    for r in range(3):
        for c in range(3):
            left[3 * r + c] = A1[3 * r + c] * (e1 if c < 2 else 1.0)
            right[3 * r + c] = back[3 * r + c] / (e0 if r < 2 else 1.0)
    for k in range(PARAMETERS + 1):
        assign(X, turn.R)
        if k < 3:  # the cross products of an axis with the columns of R
            a, b = (k + 1) % 3, (k + 2) % 3
            for c in range(3):
                X[3 * k + c], X[3 * a + c], X[3 * b + c] = 0.0, -turn.R[3 * b + c], turn.R[3 * a + c]
        for i in range(3):  # the third is not scaled by a focal length
            if k == 3:
                X[3 * i], X[3 * i + 1], X[3 * i + 2] = -X[3 * i], -X[3 * i + 1], 0.0
            elif k == 4:
                X[6 + i] = 0.0
        multiply(left, X, Y)
        multiply(Y, right, X)
        for i in range(9):
            if k < PARAMETERS:
                T[i, k] = X[i] * (free[k - 3] if k >= 3 else 1.0)
            else:
                turn.H[0, i] = X[i]


@inner
def _centred(K: Array, unit_px: float, out: Array) -> None:
    """A calibration matrix about the principal point, in units of so many pixels."""
    for k in range(9):
        out[k] = 0.0
    out[0], out[1], out[4], out[8] = K[0, 0] / unit_px, K[0, 1] / unit_px, K[1, 1] / unit_px, 1.0
