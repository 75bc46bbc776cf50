"""Motions of calibrated cameras from a homography: the two poses before its plane, and the rotation without one."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors, component_sum, determinant, exponential, product, sqrt
from fmtorch.geometry.homography import SINGULAR, in_pixels
from fmtorch.geometry.homography_refine import evaluate_homographies
from fmtorch.geometry.levenberg_marquardt import GEMAN_MCCLURE, Weighted
from fmtorch.geometry.matrices import assign, extreme_root, invert, multiply, orthogonal_factor
from fmtorch.geometry.normalize import Mask, Matrices, Points
from fmtorch.geometry.pose import inverse, rays
from fmtorch.geometry.rank2_manifold import eliminate
from fmtorch.jit.kernel import Array, inner, matrix, vector
from fmtorch.jit.lanes import LANES

ITERATIONS = 2  # to the nearest rotation, from an error of 1e-8 at worst, which each squares
FLAT = 1e-9  # of S, the squares of the stretch less one, below which there is no translation


class PlanePoses(NamedTuple):
    """The two poses that explain a plane's homography, ``H ~ K1 (R + t n^T) K0^-1``, that with more points first.
    R: rotation, X1 = R X0 + t. t: in distances of camera 0 from the plane. normal: n, unit, n^T X0 = 1 on the plane.
    in_front: share of the points that lie on the plane before both cameras. valid: False where there is no such
    pose; R is then the identity, t and n are zero. Where t is parallel to n the two are one; without translation t is
    zero and so is n."""

    R: Float[Tensor, "*batch 2 3 3"]
    t: Float[Tensor, "*batch 2 3"]
    normal: Float[Tensor, "*batch 2 3"]
    in_front: Float[Tensor, "*batch 2"]
    valid: Bool[Tensor, "*batch 2"]


def poses_from_homography(
    H: Matrices, K0: Matrices, K1: Matrices, x0: Points, x1: Points, mask: Mask | None = None
) -> PlanePoses:
    """Poses of two calibrated cameras before a plane, from its homography ``x1 ~ H x0``.

    Malis and Vargas (2007), Deeper understanding of the homography decomposition for vision-based control (INRIA
    RR-6303, section 4), in closed form: G = K1^-1 H K0, scaled to a second singular value of 1, is R + t n^T, and the
    normals follow from S = G^T G - I. Of the four solutions two have the points before the cameras, of which nothing in
    one pair of images tells the right one. Float64 inside, H's type outside.

    Args:
        H: homographies (..., 3, 3), of any scale and sign.
        K0: calibration matrices (..., 3, 3) of image 0.
        K1: those of image 1.
        x0: points of the plane in image 0, (..., N, 2), px.
        x1: their matches in image 1.
        mask: (..., N), True for the matches that count, the inliers of H; all by default.

    Returns:
        A `PlanePoses`. The result has the same bits in any batch and with any padding.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import homography_points, poses_from_homography
        >>> t, n = torch.tensor([0.2, 0.0, 0.1]), torch.tensor([0.0, 0.0, 1.0])  # a step before a wall
        >>> H = torch.eye(3) + t[:, None] * n
        >>> x0 = torch.rand(20, 2, generator=torch.Generator().manual_seed(0))
        >>> poses = poses_from_homography(H, torch.eye(3), torch.eye(3), x0, homography_points(H, x0))
        >>> bool((poses.t - t).abs().sum(-1).amin() < 1e-5), poses.valid.tolist()
        (True, [True, True])
    """
    kept = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    kept = kept & (x0.isfinite() & x1.isfinite()).all(-1)
    G, inverses, regular = _calibrated(H, K0, K1)
    ray0, ray1 = (rays(K, torch.where(kept[..., None], x, 0.0)) for K, x in zip(inverses, (x0, x1), strict=True))
    depth = component_sum(ray1 * component_sum(G[..., None] * ray0[None], 1))
    behind = _balance(depth, kept) < 0
    G, depth = torch.where(behind, -G, G), torch.where(behind[..., None], -depth, depth)
    R, t, n = _decomposed(G)
    height = component_sum(n[..., None] * ray0[:, None])  # (2, *batch, n)
    away = _balance(height, kept) < 0
    t, n = torch.where(away, -t, t), torch.where(away, -n, n)
    before = torch.where(away[..., None], -height, height) > 0
    seen = (before | (n == 0).all(0)[..., None]) & (depth > 0) & kept
    share = seen.sum(-1).to(torch.float64) / kept.sum(-1).clamp_min(1)
    swapped = share[1] > share[0]
    R, t, n, share = (torch.where(swapped, a.flip(-1 - swapped.dim()), a) for a in (R, t, n, share))
    valid = regular & (share > 0.5) & R.isfinite().all(0).all(0)
    eye = torch.eye(3, dtype=R.dtype, device=R.device).reshape(3, 3, *[1] * valid.dim())
    R, t, n = torch.where(valid, R, eye), torch.where(valid, t, 0.0), torch.where(valid, n, 0.0)
    poses = [a.to(H.dtype) for a in (R.movedim((0, 1), (-2, -1)), t.movedim(0, -1), n.movedim(0, -1), share)]
    R, t, n = (a.movedim(0, -1 - k) for a, k in zip(poses[:3], (2, 1, 1), strict=True))
    return PlanePoses(R, t, n, poses[3].movedim(0, -1), valid.movedim(0, -1))


def _calibrated(H: Tensor, K0: Tensor, K1: Tensor) -> tuple[Tensor, list[Tensor], Tensor]:
    """K1^-1 H K0 at unit second singular value, K0^-1 and K1^-1, and whether all are regular; matrices (3, 3, *s)."""
    H, K0, K1 = (A.to(torch.float64).movedim((-2, -1), (0, 1)) for A in (H, K0, K1))
    regular = torch.stack([A.isfinite().all(0).all(0) for A in (H, K0, K1)]).all(0)
    eye = torch.eye(3, dtype=H.dtype, device=H.device).reshape(3, 3, *[1] * regular.dim())
    H, K0, K1 = (torch.where(regular, A, eye) for A in (H, K0, K1))
    largest = H.abs().amax((0, 1))
    H = H / torch.where(largest > 0, largest, 1.0)
    (inverse0, regular0), (inverse1, regular1) = inverse(K0), inverse(K1)
    regular = regular & regular0 & regular1
    G = product(product(inverse1, H), K0)
    middle = sqrt(_middle_eigenvalue(product(G.transpose(0, 1), G)).clamp_min(0))
    G = G / torch.where(middle > 0, middle, 1.0)
    regular = regular & (middle > 0) & (determinant(G).abs() > SINGULAR)
    return torch.where(regular, G, eye), [torch.where(regular, A, eye) for A in (inverse0, inverse1)], regular


def _middle_eigenvalue(A: Tensor) -> Tensor:
    """Of symmetric matrices (3, 3, *s)."""
    mean, m, _, constant, outer = extreme_root(A)
    middle = (sqrt(3 * (2 - outer).clamp_min(0) * (2 + outer)) - outer) / 2
    return mean + m * torch.where(constant < 0, -middle, middle)


def _decomposed(G: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Both pairs of (R, t, n) up to the sign of (t, n): (3, 3, 2, *s), (3, 2, *s), (3, 2, *s)."""
    eye = torch.eye(3, dtype=G.dtype, device=G.device).reshape(3, 3, *[1] * (G.dim() - 2))
    S = product(G.transpose(0, 1), G) - eye
    C = cofactors(S)
    root = sqrt((-torch.stack([C[0, 0], C[1, 1], C[2, 2]])).clamp_min(0))
    e01, e02, e12 = (torch.where(c >= 0, 1.0, -1.0).to(G.dtype) for c in (C[0, 1], -C[0, 2], C[1, 2]))
    halves = torch.stack([
        torch.stack([torch.zeros_like(root[0]), root[2], e12 * root[1]]),
        torch.stack([root[2], torch.zeros_like(root[0]), -e02 * root[0]]),
        torch.stack([e01 * root[1], root[0], torch.zeros_like(root[0])]),
    ])  # fmt: skip
    best = torch.stack([S[0, 0], S[1, 1], S[2, 2]]).abs().argmax(0)
    row, half = (torch.gather(A, 0, best.expand(1, 3, *best.shape))[0] for A in (S, halves))
    n = torch.stack([row + half, row - half], 1)
    flat = S.abs().amax((0, 1)) < FLAT
    length = sqrt(component_sum(n * n))
    n = torch.where(flat | (length == 0), 0.0, n / torch.where(length > 0, length, 1.0))
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    nu = 2 * determinant(G).abs()
    rho, tau = sqrt((2 + trace + nu).clamp_min(0)), sqrt((2 + trace - nu).clamp_min(0))
    side = torch.where(torch.gather(row, 0, best[None])[0] >= 0, 1.0, -1.0).to(G.dtype)
    star = tau / 2 * (side * rho * n.flip(1) - tau * n)
    R = eye[:, :, None] - (2 / nu) * star[:, None] * n[None]
    R = product(G[:, :, None].expand_as(R), R)
    for _ in range(ITERATIONS):  # to the nearest rotation (Newton and Schulz)
        R = 1.5 * R - 0.5 * product(R, product(R.transpose(0, 1), R))
    return R, component_sum(R * star[None], 1), n


def _balance(value: Tensor, kept: Tensor) -> Tensor:
    """How many of the kept are more often positive than negative."""
    return torch.where(kept, torch.sign(value), 0.0).sum(-1)


# The homography of a camera that turns, ``H = K1 R K0^-1``, fitted to the matches of one pair, compiled

TURN_PARAMETERS = 5  # three of the rotation, the logarithms of two focal lengths
LOSS = 3.0  # noises; scale of the loss
TURN_STEPS = 12
DAMPING, MAX_DAMPING = 1e-6, 1e6
TOLERANCE = 1e-4  # nats that a step must gain


class _Turn(NamedTuple):
    """R (9,), the logarithms of two focal lengths over those of the calibration matrices (2,), K1 R K0^-1 (1, 9)."""

    R: Array
    focal: Array
    H: Array


@inner
def fit_rotation(
    points: Array, noise: Array, models: Array, precision: Array, s: float, parameters: Array, fitted: Array
) -> float:
    """R and focal lengths of least robust cost -> parameters (11,): logarithms, R; K1 R K0^-1 -> fitted (9,).
    Starts at the rotation nearest to K1^-1 H K0. points (4, n) and s in pixels. models: F, H, K0, K1 (4, 3, 3).
    precision: (2, 2), of the logarithms of the focal lengths, infinite: known. Returns the cost of the prior, infinite
    where a calibration is singular."""
    H, K0, K1 = models[1], models[2], models[3]
    n, unit_px = len(noise), math.sqrt(abs(K0[0, 0] * K1[0, 0]))
    A0, A1, back = vector(9), vector(9), vector(9)
    _centred(K1, unit_px, A1)
    turn = _Turn(vector(9), np.zeros(2), matrix(1, 9))
    if not (unit_px > 0 and invert(K1.ravel(), A0)):
        return math.inf
    multiply(A0, H.ravel(), back)
    multiply(back, K0.ravel(), turn.R)
    _centred(K0, unit_px, A0)
    if not (orthogonal_factor(turn.R) and invert(A0, back)):
        return math.inf
    x, weight, s2, unit_s = matrix(4, n), vector(n), vector(n), s / unit_px
    for i in range(n):
        for image in range(2):
            K = models[2 + image]
            x[2 * image, i] = (points[2 * image, i] - K[0, 2]) / unit_px
            x[2 * image + 1, i] = (points[2 * image + 1, i] - K[1, 2]) / unit_px
        weight[i] = 1 / (noise[i] * noise[i])
        s2[i] = (LOSS * unit_s * noise[i]) * (LOSS * unit_s * noise[i])
    matches = Weighted(x, weight, s2, GEMAN_MCCLURE, matrix(2, 0))
    prior, free = np.zeros((2, 2)), np.zeros(2)
    for a in range(2):
        free[a] = precision[a, a] < math.inf
    for a in range(2):
        for b in range(2):
            prior[a, b] = precision[a, b] if free[a] * free[b] > 0 else 0.0
    _minimise(turn, A1, back, matches, unit_s, prior, free)
    assign(parameters[:2], turn.focal)
    assign(parameters[2:], turn.R)
    centre = np.array([K0[0, 2], K0[1, 2], K1[0, 2], K1[1, 2]])
    in_pixels(turn.H[0], centre, unit_px, fitted)
    return _cost(turn.focal, prior)


@inner
def _minimise(turn: _Turn, A1: Array, back: Array, matches: Weighted, s: float, prior: Array, free: Array) -> None:
    """Levenberg and Marquardt's steps from a turn, in place. free (2,): 1 for a focal length that is not known."""
    trial = _Turn(vector(9), vector(2), matrix(1, 9))
    T, products, cost, step = matrix(9, TURN_PARAMETERS), np.empty((1, 10, 10)), vector(1), vector(TURN_PARAMETERS)
    _model(turn, A1, back, free, T)
    evaluate_homographies(turn.H, matches, True, products, cost)
    best, damping = cost[0] / (2 * s * s) + _cost(turn.focal, prior), DAMPING
    for _ in range(TURN_STEPS):
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
    M = np.zeros((TURN_PARAMETERS, LANES))
    for a in range(TURN_PARAMETERS):
        for b in range(TURN_PARAMETERS + 1):
            total = 0.0
            for i in range(9):
                if b == TURN_PARAMETERS:
                    total -= T[i, a] * products[i, 9]
                else:
                    for k in range(9):
                        total += T[i, a] * products[i, k] * T[k, b]
            M[a, b] = total / (s * s)
    for a in range(2):
        for b in range(2):
            M[3 + a, 3 + b] += prior[a, b]
            M[3 + a, TURN_PARAMETERS] -= prior[a, b] * focal[b]
        M[3 + a, 3 + a] += 1 - free[a]
    for a in range(TURN_PARAMETERS):
        M[a, a] += damping * M[a, a] + 1e-300
    eliminate(M, TURN_PARAMETERS)
    for a in range(TURN_PARAMETERS):
        out[a] = M[a, TURN_PARAMETERS]


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
    for k in range(TURN_PARAMETERS + 1):
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
            if k < TURN_PARAMETERS:
                T[i, k] = X[i] * (free[k - 3] if k >= 3 else 1.0)
            else:
                turn.H[0, i] = X[i]


@inner
def _centred(K: Array, unit_px: float, out: Array) -> None:
    """A calibration matrix about the principal point, in units of so many pixels."""
    for k in range(9):
        out[k] = 0.0
    out[0], out[1], out[4], out[8] = K[0, 0] / unit_px, K[0, 1] / unit_px, K[1, 1] / unit_px, 1.0
