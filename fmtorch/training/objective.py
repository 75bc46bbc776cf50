"""What a pruner is trained for: a loss of its classification of matches, and losses of the geometry fitted with them.

Each loss is a mean over the pairs that it can judge. A pair that it cannot judge (no labelled match, a fit that failed,
no true geometry) adds zero to loss and gradient; where that holds for all pairs, the loss is zero and still attached to
the graph. So no training step needs to be skipped."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Int8, Real
from torch import Tensor

from fmtorch.geometry import arithmetic, epipolar
from fmtorch.geometry.eight_point import eight_point
from fmtorch.jit.kernel import F8x1, F8x2, I8x1, for_each_pair, kernel
from fmtorch.jit.random import Stream, mixed_seed, stream_state, uniform_kernel
from fmtorch.metrics import nsgd
from fmtorch.metrics.nsgd import BORDER, line_of, segment_in_image
from fmtorch.pruning.networks.architectures import by_calibration
from fmtorch.pruning.networks.learned import Prediction
from fmtorch.training.labelled import LabelledMatches
from fmtorch.training.options import ObjectiveWeights

LIMIT_E = 0.1  # squared focal lengths; clamp of the geometric loss of Zhang et al. (OANet, ICCV 2019), their code
LIMIT_F = 0.03  # squared half longer sides of the image; the same code's clamp for fundamental matrices
NORMAL_FLOOR = 1e-6  # length of an epipolar line's normal, for F of unit size in normalised coordinates, taken for none
TRIES = 4  # draws made for each point wanted; those whose epipolar line misses image 1 are dropped


class Objective(ObjectiveWeights):
    """The loss of a batch, as a sum of terms that a config weighs; every stage of the network is supervised."""

    def __call__(self, prediction: Prediction, batch: LabelledMatches, step: int) -> dict[str, Float[Tensor, ""]]:
        """The terms of the loss that count at this step, unweighted, and their weighted sum `loss`, with finite
        gradients.
        step: optimisation steps done so far. Pairs without labels, or whose fit is not determined, add nothing."""
        terms = {}
        if self.classification:
            judged = prediction.judged
            label = batch.label if judged is None else torch.where(judged, batch.label, -1)
            terms["classification"] = classification_loss(prediction.logit, label)
        if step >= self.classification_steps and (self.geometric or self.nsgd):
            F, valid = fits(prediction, batch)
            c = batch.correspondences
            if c.size0 is None or c.size1 is None:
                raise ValueError("the geometric losses need image sizes (size0, size1) of every pair")
            models, options = (F, batch.F, c.size0, c.size1), dict[str, Any](valid=valid, seed=step, key=c.keys)
            if self.geometric:
                K0, K1 = (c.K0, c.K1) if self.coordinates == "K" else (None, None)
                if self.coordinates == "K" and (K0 is None or K1 is None):
                    raise ValueError("objective.coordinates=K needs calibration matrices; the data set has none")
                terms["geometric"] = geometric_loss(*models, K0=K0, K1=K1, points=self.points, **options)
            if self.nsgd:
                terms["nsgd"] = nsgd_loss(*models, limit=self.nsgd_limit, samples=self.points, **options)
        total = 0 * prediction.logit.sum()
        for name, value in terms.items():
            total = total + getattr(self, name) * value.to(total.dtype)
        return {**terms, "loss": total}


def fits(
    prediction: Prediction, batch: LabelledMatches
) -> tuple[Float[Tensor, "stages b 3 3"], Bool[Tensor, "stages b"]]:
    """The fundamental matrices of each stage in pixels, and which are valid: the network's own, or weighted 8-point."""
    c = batch.correspondences
    if prediction.F is not None:
        return prediction.F, _valid_models(prediction.F)
    x0, x1 = (x.to(torch.float64).expand(len(prediction.weight), *x.shape) for x in (c.x0, c.x1))
    return eight_point(x0, x1, prediction.weight.to(torch.float64), c.mask.expand(prediction.weight.shape))


def classification_loss(logit: Float[Tensor, "*stages b n"], label: Int8[Tensor, "*#stages b n"]) -> Float[Tensor, ""]:
    """Cross-entropy of labelled matches: the mean over the matches of each pair, then over pairs, then over stages.

    Classes are not balanced, unlike by Yi et al. (CVPR 2018): the optimum is the log-odds that a match is an inlier.

    Args:
        logit: log-odds that a match is an inlier, of one or more stages.
        label: 1 inlier, 0 outlier, -1 ignored, also in masked slots; the same for all stages, or of each.

    Returns:
        The loss in nats. Its gradient with respect to a logit is at most 1; a pair with one class only is judged by it.
    """
    labelled = label >= 0
    logit = torch.where(labelled, logit.to(torch.promote_types(logit.dtype, torch.float32)), 0.0)
    target = (label > 0).to(logit.dtype)
    weight = labelled.to(logit.dtype)
    total = arithmetic.stable_sum(weight)
    weight = weight / torch.where(total > 0, total, 1.0)[..., None]
    entropy = torch.nn.functional.softplus(logit) - target * logit
    return _mean_over_pairs(arithmetic.stable_sum(weight * entropy), total > 0)


def geometric_loss(
    F_est: Float[Tensor, "*stages b 3 3"], F_true: Float[Tensor, "b 3 3"], size0: Real[Tensor, "b 2"],
    size1: Real[Tensor, "b 2"],
    *, K0: Float[Tensor, "b 3 3"] | None = None, K1: Float[Tensor, "b 3 3"] | None = None,
    valid: Bool[Tensor, "*stages b"] | None = None, limit: float | None = None, points: int = 256, seed: int = 0,
    key: Int[Tensor, " b"] | None = None,
) -> Float[Tensor, ""]:  # fmt: skip
    """Squared symmetric epipolar distance of virtual points of the true geometry, clamped, in normalised coordinates.

    The sum of the two squared point-to-line distances (Hartley & Zisserman, eq. 11.10) of `virtual_points`, at most
    `limit`; the mean over the points of each pair, then over pairs, then over stages (Ranftl & Koltun, ECCV
    2018, section 3.3; squared and with these limits as in the code of Zhang et al., OANet, ICCV 2019). Beyond the
    limit a point has no gradient.

    Args:
        F_est: estimates in pixels, of any scale, of one or more stages.
        F_true: true fundamental matrices in pixels, of any scale.
        size0, size1: image sizes as (h, w), pixels.
        K0, K1: calibrations. With both, distances are in focal lengths; without, in half longer sides of the images.
        valid: False for estimates to leave out; those that are zero or not finite are left out anyway.
        limit: clamp, in squared units of the normalised coordinates; by default LIMIT_E with calibration, else LIMIT_F.
        points: virtual points for each pair.
        seed, key: the pairs' keys, which select their virtual points.

    Raises:
        ValueError: only one of K0 and K1 is given, or points is less than 1.
    """
    if (K0 is None) != (K1 is None):
        raise ValueError("only one of K0 and K1 is given; the loss needs both, or neither")
    limit = (LIMIT_F if K0 is None else LIMIT_E) if limit is None else limit
    A = torch.stack([_by_size(s) if K is None else K.to(torch.float64) for K, s in ((K0, size0), (K1, size1))])
    x0, x1, mask = virtual_points(F_true, size0, size1, count=points, seed=seed, key=key)
    finite, regular = A.isfinite().all(-1).all(-1), (A.diagonal(dim1=-2, dim2=-1) != 0).all(-1)  # upper triangular
    calibrated = (finite & regular).all(0)
    A0, A1 = torch.where(calibrated[:, None, None], A, torch.eye(3, dtype=A.dtype, device=A.device))
    mask = mask & calibrated[:, None]
    valid = _valid_models(F_est, valid)
    F = epipolar.unit_largest(torch.where(valid[..., None, None], F_est.to(torch.float64), 0.0))
    F = epipolar.unit_largest(arithmetic.matmul3(arithmetic.matmul3(A1.mT, F), A0))
    e, squared0, squared1 = epipolar.residual_and_normals(F, by_calibration(x0, A0), by_calibration(x1, A1))
    floor = NORMAL_FLOOR**2
    squared = e * e * (1 / (squared0 + floor) + 1 / (squared1 + floor))
    count = mask.sum(-1)
    mean = arithmetic.stable_sum(torch.where(mask, squared.clamp(max=limit), 0.0)) / count.clamp(min=1)
    return _mean_over_pairs(mean, valid & (count > 0)).to(F_est.dtype)


def nsgd_loss(
    F_est: Float[Tensor, "*stages b 3 3"], F_true: Float[Tensor, "b 3 3"], size0: Real[Tensor, "b 2"],
    size1: Real[Tensor, "b 2"],
    *, valid: Bool[Tensor, "*stages b"] | None = None, limit: float | None = None, samples: int = 100, seed: int = 0,
    key: Int[Tensor, " b"] | None = None,
) -> Float[Tensor, ""]:  # fmt: skip
    """The benchmark's own figure as a loss: `fmtorch.metrics.nsgd` without its cap, the mean over pairs and stages.

    A pair without an accepted draw (lines miss the image) counts 1 without gradient: train with another loss, too.

    Args:
        F_est, F_true, size0, size1, valid: as of `geometric_loss`.
        limit: clamp of a pair's figure, in image diagonals, beyond which it has no gradient; None: no clamp.
        samples: accepted draws for each pair.
        seed, key: the pairs' keys, which select their draws.

    Raises:
        ValueError: samples is less than 1.
    """
    valid = _valid_models(F_est, valid)
    F = torch.where(valid[..., None, None], F_est.to(torch.float64), 0.0)
    value = nsgd(F_true.to(torch.float64), F, size0, size1, samples=samples, seed=seed, key=key, cap=False)
    value = value if limit is None else value.clamp(max=limit)
    return _mean_over_pairs(value, valid & _valid_models(F_true)).to(F_est.dtype)


def virtual_points(
    F: Float[Tensor, "b 3 3"], size0: Real[Tensor, "b 2"], size1: Real[Tensor, "b 2"],
    *, count: int = 256, seed: int = 0, key: Int[Tensor, " b"] | None = None,
) -> tuple[Float[Tensor, "b n 2"], Float[Tensor, "b n 2"], Bool[Tensor, "b n"]]:  # fmt: skip
    """Points of image 0 and, on their epipolar lines, points of image 1, each inside its image; without gradients.

    A point is drawn uniformly in image 0, its partner uniformly on the part of its line inside image 1, as NSGD draws
    them (see `fmtorch.metrics.nsgd`). Published losses move a regular grid onto the geometry instead (Ranftl & Koltun,
    ECCV 2018, section 3.3; Zhang et al., OANet, ICCV 2019), which puts some of the points outside the images.

    Args:
        F: true fundamental matrices in pixels, of any scale.
        size0, size1: image sizes as (h, w), pixels.
        count: points for each pair.
        seed, key: of the draws; the pairs' keys, 0 for all where None.

    Returns:
        Points x0, x1 in pixels and a mask, `count` slots for each pair, (0, 0) where masked. There are fewer points
        where fewer than one in TRIES lines meets image 1, and none where F is zero or not finite.

    Raises:
        ValueError: count is less than 1.
    """
    if count < 1:
        raise ValueError(f"count is {count}; it must be at least 1")
    F = F.detach().to(torch.float64)
    valid = F.isfinite().all(-1).all(-1)
    F = epipolar.unit_largest(torch.where(valid[:, None, None], F, 0.0))
    key = torch.zeros(len(F), dtype=torch.int64) if key is None else key
    tensors, out = (F, size0.double(), size1.double(), key[:, None]), torch.empty(len(F), count, 5, dtype=torch.float64)
    points = for_each_pair(points_on_lines, tensors, mixed_seed(seed, Stream.TRAINING), out=out, kind=torch.float64)
    return points[..., :2], points[..., 2:4], points[..., 4] > 0


@kernel
def points_on_lines(F: F8x2, size0: F8x1, size1: F8x1, key: I8x1, mixed_seed: int, out: F8x2) -> None:
    """The `virtual_points` of a pair, x0, y0, x1, y1, 1 -> out (count, 5); 0 past the last."""
    state, count = stream_state(mixed_seed, key[0]), 0
    out[:] = 0
    for draw in range(TRIES * len(out)):
        if count == len(out):
            break
        x0 = uniform_kernel(state, 3 * draw) * size0[1] + BORDER
        y0 = uniform_kernel(state, 3 * draw + 1) * size0[0] + BORDER
        share = uniform_kernel(state, 3 * draw + 2)
        a, b, c = line_of(F, x0, y0)
        left, top, right, bottom, hits = segment_in_image(a, b, c, size1, BORDER)
        if hits:
            out[count, 0], out[count, 1], out[count, 4] = x0, y0, 1
            out[count, 2], out[count, 3] = left + share * (right - left), top + share * (bottom - top)
            count += 1


def _mean_over_pairs(value: Float[Tensor, "*stages b"], counted: Bool[Tensor, "*#stages b"]) -> Float[Tensor, ""]:
    """The mean over the pairs that count, of each stage, then over stages; 0 for a stage where none counts."""
    counted = counted.expand(value.shape)
    return (arithmetic.stable_sum(torch.where(counted, value, 0.0)) / counted.sum(-1).clamp(min=1)).mean()


def _valid_models(F: Float[Tensor, "*stages b 3 3"], valid: Tensor | None = None) -> Bool[Tensor, "*stages b"]:
    """Which matrices are finite, not zero, and not said to be invalid."""
    finite = F.detach().isfinite().all(-1).all(-1) & (F.detach() != 0).any(-1).any(-1)
    return finite if valid is None else finite & valid


def _by_size(size: Real[Tensor, "b 2"]) -> Float[Tensor, "b 3 3"]:
    """From coordinates about the image's centre, in half longer sides, to pixels."""
    h, w = size.to(torch.float64).unbind(-1)
    half = torch.maximum(h, w) / 2
    zero, ones = torch.zeros_like(h), torch.ones_like(h)
    return torch.stack([half, zero, (w - 1) / 2, zero, half, (h - 1) / 2, zero, zero, ones], -1).reshape(-1, 3, 3)
