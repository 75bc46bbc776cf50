"""Which configuration a pair of images is in: general, planar, a rotation, one photograph twice, or unrelated."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Real
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair
from fmtorch.core.estimate import CONFIGURATIONS
from fmtorch.geometry import configuration_kernels as compiled
from fmtorch.geometry.arithmetic import logarithm
from fmtorch.geometry.rotation_kernels import Cameras

Array = NDArray[Any]

GENERAL, PLANAR, ROTATION, IDENTICAL, UNRELATED = range(len(CONFIGURATIONS))
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
    logarithms of both focal lengths; scaled: a and b.
    """

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
def configuration_evidence(
    F: Float[Tensor, "b 3 3"],
    H: Float[Tensor, "b 3 3"],
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    mask: Bool[Tensor, "b n"] | None = None,
    prior: Float[Tensor, "b n"] | None = None,
    noise: Float[Tensor, "b n"] | None = None,
    size0: Real[Tensor, "b 2"] | None = None,
    size1: Real[Tensor, "b 2"] | None = None,
    K0: Float[Tensor, "b 3 3"] | None = None,
    K1: Float[Tensor, "b 3 3"] | None = None,
    focal_precision: Float[Tensor, "b 2 2"] | None = None,
) -> Evidence:
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
    out = torch.empty(len(F), compiled.COLUMNS, dtype=torch.float64)
    rows = for_each_pair(_into, given, out=out, kind=torch.float64)
    columns = [rows[:, k] for k in (compiled.LINE, compiled.PLANE, compiled.BOTH, compiled.TURN, compiled.COPY)]
    columns += [rows[:, k] for k in (compiled.NOISE, compiled.MATCHES, compiled.ON_PLANE, compiled.ON_LINE)]
    columns += [rows[:, compiled.ROTATION : compiled.SCALED].reshape(-1, 3, 3)]
    columns += [rows[:, compiled.FOCALS : compiled.ROTATION], rows[:, compiled.SCALED :]]
    return Evidence(*columns)


def _into(x0: Array, x1: Array, mask: Array, prior: Array, noise: Array, *known: Array) -> None:
    models, size0, size1, precision, out = known
    F, H, K0, K1 = models
    matches = compiled.Matches(x0, x1, mask, prior, noise)
    compiled.weigh(matches, compiled.Models(F, H, size0, size1), Cameras(K0, K1, precision), out)


def classified(evidence: Evidence, focal_known: Bool[Tensor, " b"] | None = None) -> Int[Tensor, " b"]:
    """The kind of each pair, an index into `CONFIGURATIONS`.

    1. unrelated: neither F nor H explains more than `MIN_EVIDENCE` nats.
    2. general: matches off the plane support F, ``both - plane - log n > MIN_PARALLAX``: by the Bayesian information
       criterion (Schwarz 1978), F has two parameters beyond those of its plane. `MIN_TRANSLATION` where 3. explains
       most matches.
    3. identical or rotation: ``x1 = a x0 + b``, with three parameters, or K1 R K0^-1, with three and those of the focal
       lengths, is as good as H with eight by the same criterion; of both the better one.
    4. planar.

    Args:
        evidence: of `configuration_evidence`.
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
