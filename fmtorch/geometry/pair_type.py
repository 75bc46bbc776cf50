"""Of which type a pair of images is: general, planar, a rotation, one photograph twice, or unrelated."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from fmtorch.core.types import PAIR_TYPES
from fmtorch.geometry.arithmetic import logarithm, logarithm_kernel
from fmtorch.geometry.epipolar import HOMOGRAPHY, SAMPSON
from fmtorch.geometry.homography_pose import fit_rotation
from fmtorch.jit.kernel import Array, B1x1, F8x1, F8x2, F8x3, for_each_pair, inner, kernel, matrix, vector

FREEDOM = 3.0  # degrees, of Student's law: keypoints err by more than the normal one says
PEAK = 0.36755259694786135  # of that law: 2 / (pi sqrt(3))
START, COARSEST = 1 / 1500, 1 / 300  # noise that is tried first, and the largest, of the side of an image
FINEST, FINEST_SHARE = 0.1, 1e-5  # smallest noise, px and of the side: keypoints, and float32, are no more exact
LOSS = 3.0  # noises; scale of the loss by which a rotation and a copy are fitted
STEPS, COPY_STEPS = 20, 8
NOISE_TOLERANCE, SHARE_TOLERANCE = 0.01, 1e-3  # of the last step: relative, and of a share
GROUP = 16  # densities of up to 1e10 (by FINEST_SHARE) whose product float64 holds
HALF = 0.5  # of a match that each component has beforehand
ROOT2 = math.sqrt(2)
LINE, PLANE, BOTH, TURN, COPY, NOISE, MATCHES, ON_PLANE, ON_LINE, FOCALS = range(10)
TURNED, SCALED, COLUMNS = FOCALS + 2, FOCALS + 11, FOCALS + 14
of_line, of_plane = SAMPSON.of_match, HOMOGRAPHY.of_match


class Matched(NamedTuple):
    """A pair: x0, x1 (n, 2), which are real, mask (n,); P(inlier) and relative noise (n,), empty where unknown.
    models: F, H, K0, K1 (4, 3, 3), zero where there is none. size0, size1: (h, w), empty where unknown. precision:
    (2, 2), of the logarithms of the focal lengths of K0 and K1, infinite where they are known."""

    x0: F8x2
    x1: F8x2
    mask: B1x1
    prior: F8x1
    noise: F8x1
    models: F8x3
    size0: F8x1
    size1: F8x1
    precision: F8x2


@kernel
def weigh(matches: Matched, out: F8x1) -> None:
    """The log likelihoods of the kinds, and what was fitted for them -> out (COLUMNS,), by the names above."""
    n, F, given_plane, K0 = len(matches.mask), matches.models[0], matches.models[1], matches.models[2]
    points, prior, noise = matrix(4, n), vector(n), vector(n)
    n = _gather(matches, points, prior, noise)
    points, prior, noise = points[:, :n], prior[:n], noise[:n]
    for k in range(COLUMNS):
        out[k] = 0.0
    out[MATCHES] = n
    if n == 0:
        return
    side = _side(points, matches.size0, matches.size1)
    has_line, has_plane = np.any(F != 0), np.any(given_plane != 0)
    line, plane, r, work = np.full(n, math.inf), np.full(n, math.inf), vector(n), vector(n)
    s = COARSEST * side
    if has_line:
        _distances(F.ravel(), points, noise, True, line)
        s = min(s, _noise(line, prior, side, 1, work))
    if has_plane:
        _distances(given_plane.ravel(), points, noise, False, plane)
        s = min(s, _noise(plane, prior, side, 2, work))
    out[NOISE] = s
    d, share = np.zeros((2, n)), np.zeros(3)
    _densities(line, s, side, 1, d[1])
    out[LINE] = _log_likelihood(d[1:], prior, share)
    if not has_plane:
        out[BOTH], out[ON_LINE] = out[LINE], share[1]
        return
    _densities(plane, s, side, 2, d[0])
    out[PLANE] = _log_likelihood(d[:1], prior, share)
    out[BOTH] = _log_likelihood(d, prior, share)
    out[ON_PLANE], out[ON_LINE] = share[1], share[2]
    H = vector(9)
    _fit_copy(points, noise, plane, s, H)
    out[SCALED], out[SCALED + 1], out[SCALED + 2] = H[0], H[2], H[5]
    _distances(H, points, noise, False, r)
    _densities(r, s, side, 2, d[0])
    out[COPY] = _log_likelihood(d[:1], prior, share)
    out[TURN] = -math.inf
    if K0[2, 2] != 0:
        cost = fit_rotation(points, noise, matches.models, matches.precision, s, out[FOCALS:SCALED], H)
        if math.isfinite(cost):
            _distances(H, points, noise, False, r)
            _densities(r, s, side, 2, d[0])
            out[TURN] = _log_likelihood(d[:1], prior, share) - cost


@inner
def _gather(matches: Matched, points: Array, prior: Array, noise: Array) -> int:
    """The real matches with finite coordinates -> points (4, n), prior, noise (n,); how many."""
    x0, x1, mask = matches.x0, matches.x1, matches.mask
    count = 0
    for i in range(len(mask)):
        relative = matches.noise[i] if len(matches.noise) else 1.0
        right = matches.prior[i] if len(matches.prior) else 1.0
        total = x0[i, 0] + x0[i, 1] + x1[i, 0] + x1[i, 1]
        if mask[i] and math.isfinite(total) and math.isfinite(relative) and relative > 0 and 0 <= right <= 1:
            points[0, count], points[1, count] = x0[i, 0], x0[i, 1]
            points[2, count], points[3, count] = x1[i, 0], x1[i, 1]
            prior[count], noise[count] = right, relative
            count += 1
    return count


@inner
def _side(points: Array, size0: Array, size1: Array) -> float:
    """The side of a square as large as the images, in the geometric mean; without sizes, as their matches' boxes."""
    area = 1.0
    for image in range(2):
        size = size0 if image == 0 else size1
        if len(size):
            area *= size[0] * size[1]
        else:
            for axis in range(2):
                x = points[2 * image + axis]
                area *= max(np.max(x) - np.min(x), 1.0)
    return math.sqrt(math.sqrt(area))


@inner
def _distances(model: Array, points: Array, noise: Array, line: bool, out: Array) -> None:
    """Squared Sampson distances in squared noises of each match -> out (n,); infinite where there is none."""
    for i in range(len(out)):
        x, y, u, v = points[0, i], points[1, i], points[2, i], points[3, i]
        r2 = of_line(model, x, y, u, v) if line else of_plane(model, x, y, u, v)
        r2 /= noise[i] * noise[i]
        out[i] = r2 if r2 < math.inf else math.inf  # what is not a number, too


@inner
def _noise(r2: Array, prior: Array, side: float, dimensions: int, work: Array) -> float:
    """The noise of right matches beside wrong ones, by expectation and maximisation. work: (n,)."""
    finest, coarsest, share = max(FINEST, FINEST_SHARE * side), COARSEST * side, 0.5
    n, s = len(r2), min(max(START * side, finest), coarsest)
    for _ in range(STEPS):
        _densities(r2, s, side, dimensions, work)
        right, spare, squares = 0.0, 0.0, 0.0
        for i in range(n):
            p, most = share * prior[i] * work[i], share * prior[i]
            inverse = 1 / (1 - most + p)
            spare += (prior[i] - most) * inverse
            if r2[i] < math.inf:
                p *= inverse
                right += p
                squares += p * r2[i] * (FREEDOM + dimensions) / (FREEDOM + r2[i] / (s * s))
        share = (right + HALF) / (right + spare + 2 * HALF)
        last, s = s, min(max(math.sqrt(squares / max(dimensions * right, 1e-9)), finest), coarsest)
        if abs(s - last) < NOISE_TOLERANCE * last:
            break
    return s


@inner
def _densities(r2: Array, s: float, side: float, dimensions: int, out: Array) -> None:
    """Of right matches over that of wrong ones -> out (n,), by Student's law of FREEDOM = 3 degrees.
    Of one dimension, the distance from a line, or of two, from a point; the Sampson distance being that of four
    coordinates, both are wider across than it by a root of two."""
    by = 1 / (FREEDOM * s * s)
    if dimensions == 1:
        peak = side / ROOT2 * PEAK / s
        for i in range(len(out)):
            z = 1 + r2[i] * by
            out[i] = peak / (z * z)
    else:
        peak = side * side / (4 * math.pi * s * s)
        for i in range(len(out)):
            z = 1 + r2[i] * by
            out[i] = peak / (z * z * math.sqrt(z))


@inner
def _log_likelihood(d: Array, prior: Array, share: Array) -> Any:
    """The maximum over the shares of sum log L -> share (j + 1,), d (j, n) being the densities of right matches.
    A match that the prior takes to be right belongs to one of the j components by their shares, and else is wrong like
    the others: ``L = 1 - P (w_1 + w_2) + P (w_1 d_1 + w_2 d_2)``."""
    j, n = d.shape
    share[0], share[1], share[2] = 1 / (j + 1), 1 / (j + 1), 1 / (j + 1) if j > 1 else 0.0
    for _ in range(STEPS):
        spare, on_plane, on_line = 0.0, 0.0, 0.0
        for i in range(n):
            p = prior[i] * share[1] * d[0, i]
            q = prior[i] * share[2] * d[1, i] if j > 1 else 0.0
            inverse = 1 / (1 - prior[i] * (share[1] + share[2]) + p + q)
            spare += prior[i] * share[0] * inverse
            on_plane += p * inverse
            on_line += q * inverse
        total = spare + on_plane + on_line + HALF * (j + 1)
        on_plane, on_line = (on_plane + HALF) / total, (on_line + HALF) / total if j > 1 else 0.0
        moved = max(abs(on_plane - share[1]), abs(on_line - share[2]))
        share[0], share[1], share[2] = 1 - on_plane - on_line, on_plane, on_line
        if moved < SHARE_TOLERANCE:
            break
    value, product = 0.0, 1.0
    for i in range(n):
        right = share[1] * d[0, i] + (share[2] * d[1, i] if j > 1 else 0.0)
        product *= 1 - prior[i] * (share[1] + share[2]) + prior[i] * right
        if i % GROUP == GROUP - 1:
            value += logarithm_kernel(product)
            product = 1.0
    return value + logarithm_kernel(product)


@inner
def _fit_copy(points: Array, noise: Array, plane: Array, s: float, H: Array) -> None:
    """x1 = a x0 + b by reweighted least squares of Geman and McClure's loss, from distances to a plane -> H (9,)."""
    n, limit = len(noise), (LOSS * s) * (LOSS * s)
    r2 = plane.copy()
    for k in range(9):
        H[k] = 0.0
    H[0], H[4], H[8] = 1.0, 1.0, 1.0
    for _ in range(COPY_STEPS):
        total, x, y, u, v = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            w = limit / (limit + r2[i]) * (limit / (limit + r2[i])) / (noise[i] * noise[i]) if r2[i] < math.inf else 0.0
            total += w
            x, y, u, v = x + w * points[0, i], y + w * points[1, i], u + w * points[2, i], v + w * points[3, i]
        if not total > 0:
            return
        x, y, u, v = x / total, y / total, u / total, v / total
        across, along = 0.0, 0.0
        for i in range(n):
            w = limit / (limit + r2[i]) * (limit / (limit + r2[i])) / (noise[i] * noise[i]) if r2[i] < math.inf else 0.0
            dx, dy = points[0, i] - x, points[1, i] - y
            across += w * (dx * (points[2, i] - u) + dy * (points[3, i] - v))
            along += w * (dx * dx + dy * dy)
        a = across / along if along > 0 and across > 0 else 1.0
        H[0], H[4], H[2], H[5] = a, a, u - a * x, v - a * y
        _distances(H, points, noise, False, r2)


GENERAL, PLANAR, ROTATION, IDENTICAL, UNRELATED = range(len(PAIR_TYPES))
MIN_EVIDENCE = 80.0  # nats; of the tuning pairs, unrelated ones reach 50 and related ones have 176 or more
MIN_PARALLAX = 12.0  # nats; of the tuning pairs, planes reach 6, and wide scenes have 70
MIN_TRANSLATION = 50.0  # nats; rotations reach 25 and copies 39: wrong matches may choose the translation they lack
PLANE_PARAMETERS, COPY_PARAMETERS = 8, 3  # of a homography, and of a similarity without rotation, or of a rotation


class Evidence(NamedTuple):
    """Log likelihoods of B pairs in nats, relative to matches that are all wrong, each at its best shares.
    line: right matches lie on epipolar lines. plane: where H takes them. both: some here and some there. rotation:
    where K1 R K0^-1 takes them, less the cost of focal lengths that differ; -inf where no cameras are given. copy:
    where ``x1 = a x0 + b`` takes them. noise: of usual matches, px. matches: how many are real. on_plane, on_line:
    shares of the matches on the plane, and off it on their lines. R: the rotation; log_focal: what is added to the
    logarithms of both focal lengths; scaled: a and b."""

    line: Float[Tensor, " b"]
    plane: Float[Tensor, " b"]
    both: Float[Tensor, " b"]
    rotation: Float[Tensor, " b"]
    copy: Float[Tensor, " b"]
    noise: Float[Tensor, " b"]
    matches: Float[Tensor, " b"]
    on_plane: Float[Tensor, " b"]
    on_line: Float[Tensor, " b"]
    R: Float[Tensor, "b 3 3"]
    log_focal: Float[Tensor, "b 2"]
    scaled: Float[Tensor, "b 3"]


@torch.no_grad()
def pair_evidence(
    F: Float[Tensor, "b 3 3"], H: Float[Tensor, "b 3 3"], x0: Float[Tensor, "b n 2"], x1: Float[Tensor, "b n 2"],
    mask: Bool[Tensor, "b n"] | None = None, prior: Float[Tensor, "b n"] | None = None,
    noise: Float[Tensor, "b n"] | None = None, size0: Real[Tensor, "b 2"] | None = None,
    size1: Real[Tensor, "b 2"] | None = None, K0: Float[Tensor, "b 3 3"] | None = None,
    K1: Float[Tensor, "b 3 3"] | None = None, focal_precision: Float[Tensor, "b 2 2"] | None = None,
) -> Evidence:  # fmt: skip
    """How well the kinds of pairs explain the matches of B pairs; `classified` decides.

    Args:
        F: fundamental matrices in pixels; zero or not finite where there is none.
        H: homographies; likewise.
        x0: all matches that were given to both estimators, right and wrong, px.
        x1: their points in image 1.
        mask: which are real; all by default.
        prior: P(inlier) of each match, in [0, 1]; 1 by default: all shares are found in the matches.
        noise: of each match, relative to a usual one's; 1 by default.
        size0: size (h, w) of image 0, px; by default that of the box of its matches.
        size1: that of image 1.
        K0: calibration of image 0; without both no rotation is considered.
        K1: that of image 1.
        focal_precision: inverse covariance of the logarithms of the focal lengths about those of K0 and K1; infinite on
            the diagonal where they are known exactly, as by default.

    Returns:
        An `Evidence`, float64, without gradient. A pair has the same bits in any batch and with any padding.
    """
    mask = torch.ones(x0.shape[:2], dtype=torch.bool, device=x0.device) if mask is None else mask
    exact = torch.diag_embed(torch.full((len(F), 2), torch.inf, dtype=torch.float64, device=F.device))
    precision = exact if focal_precision is None else focal_precision
    cameras = (K0, K1) if K0 is not None and K1 is not None else (torch.zeros_like(F),) * 2
    models = torch.stack([A.to(torch.float64) for A in (F, H, *cameras)], 1)
    models = torch.where(models.isfinite().flatten(2).all(2)[..., None, None], models, 0.0)
    sizes = (None if size is None else size.to(torch.float64) for size in (size0, size1))
    given = (x0, x1, mask, prior, noise, models, *sizes, precision)
    out = torch.empty(len(F), COLUMNS, dtype=torch.float64)
    rows = for_each_pair(weigh, given, out=out, kind=torch.float64, group=Matched)
    fitted = rows[:, TURNED:SCALED].reshape(-1, 3, 3), rows[:, FOCALS:TURNED], rows[:, SCALED:]
    return Evidence._make([*rows[:, :FOCALS].unbind(1), *fitted])


def classified(evidence: Evidence, focal_known: Bool[Tensor, " b"] | None = None) -> Int[Tensor, " b"]:
    """The kind of each pair, an index into `PAIR_TYPES`.

    1. unrelated: neither F nor H explains more than `MIN_EVIDENCE` nats.
    2. general: matches off the plane support F, ``both - plane - log n > MIN_PARALLAX``: by the Bayesian information
       criterion (Schwarz 1978), F has two parameters beyond those of its plane. `MIN_TRANSLATION` where 3. explains
       most matches.
    3. identical or rotation: ``x1 = a x0 + b``, with three parameters, or K1 R K0^-1, with three and those of the focal
       lengths, is as good as H with eight by the same criterion; of both the better one.
    4. planar.

    Args:
        evidence: of `pair_evidence`.
        focal_known: whether both focal lengths are known exactly; they are not by default.
    """
    log_n = logarithm(evidence.matches.clamp_min(2.0))
    known = torch.zeros_like(log_n, dtype=torch.bool) if focal_known is None else focal_known
    kind = torch.full_like(log_n, PLANAR, dtype=torch.int64)
    plane = evidence.plane - PLANE_PARAMETERS / 2 * log_n
    copy = evidence.copy - COPY_PARAMETERS / 2 * log_n
    turned = evidence.rotation - (COPY_PARAMETERS + torch.where(known, 0.0, 2.0)) / 2 * log_n
    kind = torch.where(turned >= plane, ROTATION, kind)
    kind = torch.where((copy >= plane) & (copy >= turned), IDENTICAL, kind)
    still = (kind != PLANAR) & (evidence.on_plane > evidence.on_line)
    needed = torch.where(still, MIN_TRANSLATION, MIN_PARALLAX)
    kind = torch.where(evidence.both - evidence.plane - log_n > needed, GENERAL, kind)
    return torch.where(torch.maximum(evidence.line, evidence.plane) > MIN_EVIDENCE, kind, UNRELATED)
