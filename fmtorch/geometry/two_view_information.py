"""Information of matches about a two-view estimate, and their noise; see `two_view_covariance`.

Entries come first: vectors are (3, b), matrices (3, 3, b), centred points (2, b, n).
"""

from __future__ import annotations

import torch
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, sqrt, stable_sum
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.rank2 import complement

PARAMETERS = 7
WINDOW = 2.5  # noises within which distances are taken to be those of right matches
WINDOW_SHARE = 0.911256360935392  # `kept_share` of WINDOW
ITERATIONS = 8  # of the noise; each leaves a quarter of the error (by the slope of `kept_share` at WINDOW)
MIN_NOISE_PX = 1e-3  # float32 coordinates of large images are no finer
MIN_SPARE_MATCHES = 3  # beyond the parameters, from which on the noise is estimated
TERMS, WIDEST = 64, 6.0  # of the series of `kept_share`, and from where on it is one to 1e-7


def tangents(R: Tensor, t: Tensor, focal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """F (3, 3, b) between centred pixels, its derivatives by the parameters (3, 3, 7, b), and the basis (3, 2, b)."""
    basis = torch.stack(complement(t), 1)
    E = _cross(t, R)
    axes = torch.eye(3, dtype=R.dtype, device=R.device)[..., None].expand(3, 3, R.shape[-1])
    turned = [_cross(t, _cross(axes[k], R)) for k in range(3)]
    shifted = [_cross(basis[:, k], R) for k in range(2)]
    scale0, scale1 = (torch.stack([1 / f, 1 / f, torch.ones_like(f)]) for f in focal)
    by0, by1 = (torch.stack([-1 / f, -1 / f, torch.zeros_like(f)]) for f in focal)
    pixels = scale1[:, None] * scale0[None]
    scaled = [A * pixels for A in (*turned, *shifted)]
    slopes = torch.stack([*scaled, E * scale1[:, None] * by0[None], E * by1[:, None] * scale0[None]], 2)
    return E * pixels, slopes, basis


def _cross(t: Tensor, A: Tensor) -> Tensor:
    """``[t]x A`` (3, 3, b)."""
    crossed: Tensor = torch.linalg.cross(t[:, None].expand_as(A), A, dim=0)
    return crossed


def residual_slopes(F: Tensor, slopes: Tensor, a0: Tensor, a1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Signed Sampson distances (b, n), their derivatives (7, b, n) by the parameters, and the noise in two of these.

    With e = a1^T F a0 and q the sum of the squares of both lines' normals, r = e / sqrt(q), and ``dr = de / sqrt(q)``
    at the points corrected to first order, where e is zero. Zero where a point is the epipole. The last are the
    covariances (2, 2, b, n) of the derivatives by the direction of translation, in squared noises of a point: where the
    images have no parallax these derivatives are nothing but noise, in the three directions that are not corrected.
    """
    ones = torch.ones_like(a0[:1])
    line1 = component_sum(F[..., None] * torch.cat([a0, ones])[None], 1)
    line0 = component_sum(F[..., None] * torch.cat([a1, ones])[:, None], 0)
    root = inverse_root(component_sum(line1[:2] * line1[:2]) + component_sum(line0[:2] * line0[:2]))
    r = component_sum(torch.cat([a1, ones]) * line1) * root
    normal = torch.cat([line0[:2], line1[:2]]) * root
    h0, h1 = torch.cat([a0 - r * normal[:2], ones]), torch.cat([a1 - r * normal[2:], ones])
    by_entry = h1[:, None] * h0[None] * root
    J = component_sum((by_entry[:, :, None] * slopes[..., None]).flatten(0, 1))
    shifted = slopes[:, :, 3:5, :, None]
    by_h0, by_h1 = component_sum(shifted * h1[:, None, None], 0), component_sum(shifted * h0[None, :, None], 1)
    by_point = torch.cat([by_h0[:2], by_h1[:2]]) * root
    corrected = component_sum(normal[:, None] * by_point)
    noise = component_sum(by_point[:, :, None] * by_point[:, None]) - corrected[:, None] * corrected[None]
    return r, J, noise


def kept_share(c: Tensor) -> Tensor:
    """m / A of limits c (b,): ``1 - 1 / S``, ``S = sum_k c^2k / (2 k + 1)!!``, by the series of the normal integral."""
    square = c.clamp_max(WIDEST) * c.clamp_max(WIDEST)
    ratios = square[..., None] / torch.arange(3.0, 2 * TERMS + 3, 2, dtype=c.dtype, device=c.device)
    return 1 - 1 / (1 + component_sum(ratios.cumprod(-1), -1))


def noise_of(r: Tensor, w: Tensor, T: Tensor, parameters: Tensor) -> Tensor:
    """s (b,): ``s^2 = sum w r^2 / (share (sum w - p share sum w^2 / sum w))`` within WINDOW s, iterated from 0.6 T.

    Within a window the share m / A of the variance is left; p parameters have taken theirs of that. At most T. Without
    a limit it is started at the root mean square; of fewer matches than parameters it is not estimated.
    """
    # Of each match: its count, weight, squared weight, weighted square of the distance.
    summands = torch.stack([(w > 0).to(r.dtype), w, w * w, w * r * r])
    _, total, _, square = stable_sum(summands)
    start = torch.where(T.isfinite(), 0.6 * T, sqrt(square / total.clamp_min(1e-300)))
    s = start.clamp_min(MIN_NOISE_PX)
    for _ in range(ITERATIONS):
        count, total, squares, square = stable_sum(torch.where(r < WINDOW * s[:, None], summands, 0.0))
        spare = WINDOW_SHARE * (total - parameters * WINDOW_SHARE * squares / total.clamp_min(1e-300))
        enough = (count >= parameters + MIN_SPARE_MATCHES) & (spare > 0)
        estimate = sqrt(square / torch.where(spare > 0, spare, 1.0)).clamp_min(MIN_NOISE_PX)
        s = torch.where(enough, estimate.minimum(T), s)
    return s


def information_of(r: Tensor, J: Tensor, noise: Tensor, w: Tensor, T: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Of the matches, (7, 7, b), and what of it noise alone gives about the direction of translation, (2, 2, b)."""
    w = torch.where(r < T[:, None], w, 0.0)
    squares = stable_sum(w * w)
    factor = kept_share(T / s) * (stable_sum(w) / torch.where(squares > 0, squares, 1.0))
    rows, columns = torch.triu_indices(PARAMETERS, PARAMETERS, device=r.device)
    sums = stable_sum(J[rows] * J[columns] * w) * (factor / (s * s))
    index = torch.zeros_like(rows).new_zeros(PARAMETERS, PARAMETERS)
    index[rows, columns] = torch.arange(len(rows), device=r.device)
    return sums[torch.maximum(index, index.mT)], stable_sum(noise * w) * factor
