"""Covariance of a two-view estimate: of its pose, its focal lengths and its fundamental matrix.

The parameters of a pair are (omega, tau, log f0, log f1): R is ``exp([omega]x) R``, the direction of translation moves
along two unit tangents, ``t + B tau``, so that both are in radians. The information of a fit that minimises the robust
sum of w rho(r^2) with a loss truncated at T is J^T W J over the matches within T, J being the derivative of the Sampson
distance (Hartley & Zisserman 2004, 11.4.3), with three corrections:

1. A truncated fit does not use all that its inliers know: its variance is E[psi^2] / E[psi']^2 of that of one match
   (Huber 1981, Robust Statistics, chapter 7). With c = T / s, A = P(|z| < c) and m = A - 2 c phi(c), which both
   expectations are for the truncated square, the information is m / A of J^T W J.
2. The noise s is estimated anew from the distances below 2.5 s, consistent at normal noise: the scale of a robust fit
   is biased by its own limits and by the parameters that were fitted.
3. The derivatives by t hold noise, as if it were parallax; its expected share of their squares is taken from the
   information about the direction of translation. Without that a camera that only turns seems to have one, known to
   some ten degrees. (The bias of matrices of moments: Kanatani 1996, Statistical Optimization for Geometric
   Computation, chapter 9. The noise itself is not subtracted: where other parameters leave little, the difference of
   two estimates says that nothing is known where errors are a few degrees.)

Weights that are no inverse variances, such as P(inlier), count by ``sum w / sum w^2`` (Kish 1965). Independent noise
is assumed; on real pairs neighbours err alike, and deviations come out too small.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.arithmetic import component_sum, sqrt
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.two_view_information import PARAMETERS, information_of, noise_of, residual_slopes, tangents

DIFFUSE = (1.33, 1.33, 1.33, 1.21, 1.21, 2.3, 2.3)
"""Deviations that no parameter exceeds: of a rotation and a direction drawn uniformly (radians, each axis), and a
factor of ten in a focal length. They enter as independent information, which is nothing beside that of matches."""


class TwoViewCovariance(NamedTuple):
    """Covariances of B pairs.

    covariance: of (omega, tau, log f0, log f1), radians and logarithms; rows of known focal lengths are zero.
    tangent: the basis B of the plane across t. fundamental: covariance of F, row by row, at unit Frobenius norm, in
    pixels. noise: s, px. valid: False where R, t, a focal length, the truncation or the prior is not finite or has no
    meaning; such a pair is as one without matches.
    """

    covariance: Float[Tensor, "b 7 7"]
    tangent: Float[Tensor, "b 3 2"]
    fundamental: Float[Tensor, "b 9 9"]
    noise: Float[Tensor, " b"]
    valid: Bool[Tensor, " b"]

    @property
    def deviation_degrees(self) -> Float[Tensor, "b 2"]:
        """Root mean squared angles of rotation and of the direction of translation, in degrees.

        Where nothing is known of them they are some 132 and 98 degrees.
        """
        variances = self.covariance.diagonal(dim1=-2, dim2=-1)
        turned, shifted = component_sum(variances[:, :3], -1), component_sum(variances[:, 3:5], -1)
        return torch.rad2deg(sqrt(torch.stack([turned, shifted], -1)))


def two_view_covariance(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    R: Float[Tensor, "b 3 3"],
    t: Float[Tensor, "b 3"],
    focal: Float[Tensor, "b 2"],
    principal0: Float[Tensor, "b 2"],
    principal1: Float[Tensor, "b 2"],
    truncation: Float[Tensor, " b"],
    weight: Float[Tensor, "b n"] | None = None,
    noise: Float[Tensor, "b n"] | None = None,
    mask: Bool[Tensor, "b n"] | None = None,
    focal_precision: Float[Tensor, "b 2 2"] | None = None,
    shared_focal: Bool[Tensor, " b"] | None = None,
) -> TwoViewCovariance:
    """The covariance of pose, focal lengths and F at the optimum of a robust fit, in closed form.

    Nothing is NaN: what the matches leave open has a deviation of up to `DIFFUSE`. A local covariance knows nothing of
    another optimum: see `significance`. Float64.

    Args:
        x0: points of image 0, px.
        x1: their matches in image 1.
        R: rotation, ``X1 = R X0 + t``.
        t: translation, of any length.
        focal: focal lengths of both images, px.
        principal0: principal point of image 0, px.
        principal1: that of image 1.
        truncation: Sampson distance of a match of usual noise from which on it does not count in the fit, px; infinite
            for plain least squares.
        weight: of each match in the fit, of any scale, P(inlier) where that is known; 1 by default.
        noise: of each match, relative to a usual one's; 1 by default.
        mask: True for a real match; all by default.
        focal_precision: the Hessian, by (log f0, log f1), of the negative logarithm of the prior density that the fit
            had, of which the positive part counts; infinite on the diagonal where a focal length is known exactly. Zero
            by default.
        shared_focal: where the two focal lengths are one parameter; nowhere by default.

    Returns:
        A `TwoViewCovariance`. The result has the same bits in any batch and with any padding.

    Example:
        >>> import torch
        >>> from fmtorch.geometry import two_view_covariance
        >>> X = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 4 + torch.tensor([-2.0, -2.0, 4.0])
        >>> x0, x1 = (600 * Y[:, :2] / Y[:, 2:] for Y in (X, X + torch.tensor([-1.0, 0, 0])))
        >>> x1 = x1 + 0.5 * torch.randn(x1.shape, generator=torch.Generator().manual_seed(1))
        >>> known = torch.diag(torch.full((2,), torch.inf))[None]
        >>> result = two_view_covariance(
        ...     x0[None], x1[None], torch.eye(3)[None], torch.tensor([[-1.0, 0, 0]]), torch.full((1, 2), 600.0),
        ...     torch.zeros(1, 2), torch.zeros(1, 2), torch.tensor([1.0]), focal_precision=known,
        ... )
        >>> bool((result.deviation_degrees < 0.5).all()), round(float(result.noise[0]), 1)
        (True, 0.4)
    """
    kind = torch.float64
    open_prior = torch.zeros(len(R), 2, 2, dtype=kind, device=R.device)
    Pi = open_prior if focal_precision is None else focal_precision.to(kind)
    shared = torch.zeros_like(Pi[:, 0, 0], dtype=torch.bool) if shared_focal is None else shared_focal
    known = Pi.diagonal(dim1=-2, dim2=-1) == torch.inf
    Pi = torch.where(known[:, :, None] | known[:, None, :], 0.0, Pi)
    valid, (R, t, f, p0, p1, T, Pi) = _valid(R, t, focal, principal0, principal1, truncation, Pi)
    t = t * inverse_root(component_sum(t * t, -1))[:, None]
    real = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    w, n = (torch.ones_like(x0[..., 0]) if a is None else a for a in (weight, noise))
    real = real & valid[:, None] & (x0.isfinite() & x1.isfinite()).all(-1) & (w > 0) & (n > 0) & (w + n).isfinite()
    a0, a1 = (torch.where(real[..., None], x - p[:, None], 0.0).movedim(-1, 0) for x, p in ((x0, p0), (x1, p1)))
    w, n = torch.where(real, w, 0.0).to(kind), torch.where(real, n, 1.0).to(kind)
    F, slopes, basis = tangents(R.movedim(0, -1), t.movedim(0, -1), f.movedim(0, -1))
    r, J, in_slopes = residual_slopes(F, slopes, a0, a1)
    r, J = (r / n).abs(), J / n
    used = _directions(known, shared)
    s = noise_of(r.detach(), w, T, used.amax(0).sum(0))
    information, from_noise = information_of(r, J, in_slopes, w, T, s)
    by_direction = information[3, 3] + information[4, 4]
    share = (from_noise[0, 0] + from_noise[1, 1]) / torch.where(by_direction > 0, by_direction, 1.0)
    C = _without(_covariance(information, Pi.movedim(0, -1), used), share.clamp(0, 1))
    V = _of_fundamental(C, F, slopes, p0.movedim(0, -1), p1.movedim(0, -1))
    return TwoViewCovariance(C.movedim(-1, 0), basis.movedim(-1, 0), V.movedim(-1, 0), s, valid)


def _valid(*given: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Whether the pairs have cameras, and those, float64, in whose place others stand where they have none.

    given: R, t, focal, principal0, principal1, truncation, focal_precision.
    """
    R, t, focal, _, _, truncation, _ = given = tuple(a.to(torch.float64) for a in given)
    finite = [a.isfinite().flatten(1).all(1) for a in given if a is not truncation]
    valid = torch.stack([*finite, (t != 0).any(-1), (focal > 0).all(-1), truncation > 0]).all(0)
    zeros, ones = truncation.new_zeros(1), truncation.new_ones(1)
    places = (torch.eye(3, dtype=R.dtype, device=R.device), t.new_tensor([0.0, 0, 1]), ones, zeros, zeros, ones, zeros)
    kept = (valid.reshape(-1, *[1] * (a.dim() - 1)) for a in given)
    return valid, [torch.where(keep, a, place) for keep, a, place in zip(kept, given, places, strict=True)]


def _directions(known: Tensor, shared: Tensor) -> Tensor:
    """How the parameters move (7, 7, b), by the columns: a known one never, shared ones together by the first's."""
    b = len(known)
    used = torch.eye(PARAMETERS, dtype=torch.float64, device=known.device)[..., None].repeat(1, 1, b)
    any_known, together = known.any(-1), shared & ~known.any(-1)
    used[5, 5] = (~(known[:, 0] | (shared & any_known))).to(used.dtype)
    used[6, 6] = (~(known[:, 1] | shared)).to(used.dtype)
    used[6, 5] = together.to(used.dtype)
    return used


def _covariance(information: Tensor, Pi: Tensor, used: Tensor) -> Tensor:
    """The inverse (7, 7, b) of information, prior and `DIFFUSE` in the directions that are used; zero in others."""
    total = information + torch.diag(information.new_tensor(DIFFUSE) ** -2)[..., None]
    prior = torch.nn.functional.pad(_positive_part(Pi).movedim(-1, 0), (5, 0, 5, 0)).movedim(0, -1)
    reduced = _product(used.transpose(0, 1), _product(total + prior, used))
    idle = 1 - used.amax(0)
    eye = torch.eye(PARAMETERS, dtype=total.dtype, device=total.device)[..., None]
    M = torch.cat([reduced + eye * idle, eye.expand_as(reduced)], 1)
    for k in range(PARAMETERS):  # Gauss and Jordan, of a positive definite matrix without pivots
        M = M - (M[:, k] - eye[:, k])[:, None] * (M[k] / M[k, k])[None]
    inverse = M[:, PARAMETERS:] * (1 - idle) * (1 - idle)[:, None]
    C = _product(used, _product(inverse, used.transpose(0, 1)))
    return (C + C.transpose(0, 1)) / 2


def _without(C: Tensor, share: Tensor) -> Tensor:
    """The covariance (7, 7, b) with a share (b,) of the information about the direction of translation taken away.

    The other parameters keep their distribution given that direction, whose own covariance becomes larger. What
    `DIFFUSE` knows of it stays.
    """
    S, eye = _inverse(C[3:5, 3:5]), torch.eye(2, dtype=C.dtype, device=C.device)[..., None]
    diffuse_information = eye * DIFFUSE[3] ** -2
    grown = _inverse(_positive_part(S * (1 - share) - diffuse_information) + diffuse_information)
    by_direction = _product(C[:, 3:5], S)
    C = C + _product(by_direction, _product(grown - C[3:5, 3:5], by_direction.transpose(0, 1)))
    return (C + C.transpose(0, 1)) / 2


def _inverse(A: Tensor) -> Tensor:
    """Of symmetric matrices (2, 2, b)."""
    adjugate = torch.stack([torch.stack([A[1, 1], -A[0, 1]]), torch.stack([-A[0, 1], A[0, 0]])])
    return adjugate / (A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1])


def _positive_part(Pi: Tensor) -> Tensor:
    """Symmetric matrices (2, 2, b) with their negative eigenvalues set to zero."""
    a, b, c = Pi[0, 0], (Pi[0, 1] + Pi[1, 0]) / 2, Pi[1, 1]
    mean, half = (a + c) / 2, (a - c) / 2
    radius = sqrt(half * half + b * b)
    high, low = (mean + radius).clamp_min(0), (mean - radius).clamp_min(0)
    turn = torch.where(radius > 0, 1 / torch.where(radius > 0, radius, 1.0), 0.0)
    middle, part = (high + low) / 2, (high - low) / 2 * turn
    return torch.stack([torch.stack([middle + part * half, part * b]), torch.stack([part * b, middle - part * half])])


def _of_fundamental(C: Tensor, F: Tensor, slopes: Tensor, p0: Tensor, p1: Tensor) -> Tensor:
    """The covariance (9, 9, b) of F in pixels at unit norm, of that of the parameters."""
    pixels = torch.stack([_uncentred(A, p0, p1) for A in (F, *slopes.unbind(2))])
    entries = pixels.flatten(1, 2)
    f = entries[0] * inverse_root(component_sum(entries[0] * entries[0]))
    J = entries[1:] * inverse_root(component_sum(entries[0] * entries[0]))
    J = J - component_sum(J * f, 1)[:, None] * f
    V = _product(J.transpose(0, 1), _product(C, J))
    return (V + V.transpose(0, 1)) / 2


def _uncentred(A: Tensor, p0: Tensor, p1: Tensor) -> Tensor:
    """``T1^T A T0`` (3, 3, b): a matrix between centred pixels as one between pixels."""
    A = torch.stack([A[:, 0], A[:, 1], A[:, 2] - A[:, 0] * p0[0] - A[:, 1] * p0[1]], 1)
    return torch.stack([A[0], A[1], A[2] - A[0] * p1[0] - A[1] * p1[1]])


def _product(A: Tensor, B: Tensor) -> Tensor:
    """``A B`` of component-first matrices of any size."""
    return component_sum(A[:, :, None] * B[None], 1)
