"""The two poses of calibrated cameras before a plane, from its homography."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import cofactors, component_sum, determinant, product, sqrt
from fmtorch.geometry.homography import SINGULAR
from fmtorch.geometry.normalize import Mask, Matrices, Points
from fmtorch.geometry.pose import inverse, rays

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
    """Of symmetric matrices (3, 3, *s): the middle root of y^3 - 3 y = det X, with A = mean + m X."""
    mean = (A[0, 0] + A[1, 1] + A[2, 2]) / 3
    D = A - mean * torch.eye(3, dtype=A.dtype, device=A.device).reshape(3, 3, *[1] * mean.dim())
    m = sqrt(component_sum(component_sum(D * D, 1)) / 6)
    constant = determinant(D / torch.where(m > 0, m, 1.0)).clamp(-2.0, 2.0)
    outer = torch.full_like(m, 2.0)
    for _ in range(5):  # Newton's method, quadratic from an error of at most 0.27
        outer = (2 * outer * outer * outer + constant.abs()) / (3 * (outer * outer - 1))
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
