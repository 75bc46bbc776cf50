"""Recall over a set of pairs at a limit on their NSGD or pose error: the area under its curve, means over bins.

And the same of matches: those that agree with the true F or H, and their share before and after estimation."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from fmtorch.core.checks import checked, expect_sizes
from fmtorch.geometry import epipolar_distances, homography_transfer
from fmtorch.metrics.nsgd import diagonal

THRESHOLD = 0.05  # NSGD below which an estimate counts as recalled (Bian et al., BMVC 2019)
FINE_THRESHOLD = 0.01  # NSGD below which it counts as accurate
THRESHOLDS = (5, 10, 20)  # degrees, as SuperGlue (Sarlin et al., CVPR 2020)
MAA_MAXIMUM = 10  # degrees, as the Image Matching Challenge
BIN = 5  # degrees, as Yi et al. (CVPR 2018) and OANet (Zhang et al., ICCV 2019)


@checked
def recall(nsgd: Float[Tensor, "*batch pairs"], threshold: float = THRESHOLD) -> Float[Tensor, "*batch"]:
    """Share of all pairs with NSGD strictly below the threshold; NaN where there are no pairs.

    Args:
        nsgd: of each pair; NaN, a failure, counts as a miss.
        threshold: in image diagonals, as NSGD.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import mean_recall, recall
        >>> nsgd = torch.tensor([0.0, 0.01, 0.2, torch.nan])
        >>> recall(nsgd).item(), round(mean_recall(nsgd).item(), 3)
        (0.5, 0.45)
    """
    return (nsgd < threshold).to(nsgd.dtype).mean(-1)


@checked
def mean_recall(nsgd: Float[Tensor, "*batch pairs"], maximum: float = THRESHOLD) -> Float[Tensor, "*batch"]:
    """Mean of `recall` over thresholds from 0 to `maximum`, by default AUC@0.05: the area under its curve, exactly.

    A pair with NSGD e is recalled at the share max(0, 1 - e / maximum) of the thresholds, of which this is the mean.

    Args:
        nsgd: of each pair; NaN counts as a miss.
        maximum: the last threshold, in image diagonals.

    Raises:
        ValueError: `maximum` is not positive.
    """
    if not maximum > 0:
        raise ValueError(f"maximum is {maximum}; it must be positive")
    return (1 - torch.where(nsgd.isnan(), maximum, nsgd) / maximum).clamp(0.0, 1.0).mean(-1)


@checked
def pose_auc(
    errors: Float[Tensor, "*batch pairs"], thresholds: Sequence[float | int] = THRESHOLDS
) -> Float[Tensor, "*batch t"]:
    """Area under the recall curve of pose errors up to each threshold, divided by the threshold: in [0, 1].

    As SuperGlue and LoFTR compute it: the curve rises linearly between sorted errors, from recall 0 at error 0.

    Args:
        errors: of each pair, in degrees; NaN and infinity count as misses.
        thresholds: in degrees.

    Raises:
        ValueError: a threshold is not positive, or there is none.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import pose_auc, pose_maa
        >>> errors = torch.tensor([0.5, 4.0, torch.nan])
        >>> [round(auc, 3) for auc in pose_auc(errors).tolist()], round(pose_maa(errors).item(), 3)
        ([0.5, 0.583, 0.625], 0.567)
    """
    _expect_positive(thresholds)
    pairs = errors.shape[-1]
    errors = torch.where(errors.isnan(), torch.inf, errors).sort(dim=-1).values
    step = torch.arange(1, pairs + 1, dtype=errors.dtype, device=errors.device) / pairs
    return torch.stack([_area(errors, step, float(t)) / t for t in thresholds], -1)


def _area(errors: Tensor, step: Tensor, threshold: float) -> Tensor:
    """Trapezoids below the points (error, recall) left of the threshold, level from the last one to the threshold."""
    reached = (errors < threshold).to(errors.dtype).mean(-1, keepdim=True)
    zero = torch.zeros_like(reached)
    e = torch.cat([zero, errors.clamp(max=threshold), zero + threshold], -1)
    r = torch.cat([zero, torch.minimum(step, reached), reached], -1)
    return ((r[..., 1:] + r[..., :-1]) / 2 * e.diff(dim=-1)).sum(-1)


@checked
def pose_map(
    errors: Float[Tensor, "*batch pairs"], thresholds: Sequence[float | int] = THRESHOLDS, bin: float | int = BIN
) -> Float[Tensor, "*batch t"]:
    """Binned mAP of pose errors up to each threshold: the mean of recall at bin, 2 bin, ..., threshold.

    As Yi et al. (CVPR 2018) and OANet (Zhang et al., ICCV 2019) report it; mAP at 5 degrees is recall there. It is a
    coarse mean and usually larger than `pose_auc`, with which it is not to be compared.

    Args:
        errors: of each pair, in degrees, recalled strictly below a bin's end; NaN is a miss.
        thresholds, bin: in degrees; thresholds are multiples of `bin`.

    Raises:
        ValueError: a threshold is not a positive multiple of the bin, or there is none.
    """
    _expect_positive(thresholds)
    counts = [round(threshold / bin) if bin > 0 else 0 for threshold in thresholds]
    if not all(n > 0 and abs(n * bin - t) < 1e-9 * t for n, t in zip(counts, thresholds, strict=True)):
        raise ValueError(f"thresholds are {tuple(thresholds)}; they must be multiples of bin={bin}")
    ends = [[bin * (i + 1) for i in range(n)] for n in counts]
    return torch.stack([_recalled(errors, thresholds_of_bin, strict=True).mean(-1) for thresholds_of_bin in ends], -1)


@checked
def pose_maa(errors: Float[Tensor, "*batch pairs"], maximum: int = MAA_MAXIMUM) -> Float[Tensor, "*batch"]:
    """Mean average accuracy: the mean of recall at 1, 2, ..., `maximum` degrees.

    As the Image Matching Challenge (Jin et al., IJCV 2021) and the RANSAC tutorial (CVPR 2020) define mAA(10).

    Args:
        errors: of each pair, in degrees, recalled up to and including a threshold; NaN is a miss.
        maximum: the last threshold, in degrees.

    Raises:
        ValueError: `maximum` is less than 1.
    """
    if maximum < 1:
        raise ValueError(f"maximum is {maximum}; it must be a whole number of degrees from 1")
    return _recalled(errors, [float(i + 1) for i in range(maximum)], strict=False).mean(-1)


def _recalled(errors: Tensor, thresholds: Sequence[float | int], *, strict: bool) -> Tensor:
    """Share of errors below each threshold, or up to it: (*batch, t)."""
    limits = torch.tensor(thresholds, dtype=errors.dtype, device=errors.device)[:, None]
    below = errors[..., None, :] < limits if strict else errors[..., None, :] <= limits
    return below.to(errors.dtype).mean(-1)


def _expect_positive(thresholds: Sequence[float | int]) -> None:
    if not thresholds or not all(threshold > 0 for threshold in thresholds):
        raise ValueError(f"thresholds are {tuple(thresholds)}; they must be positive, and at least one")


# Matches that agree with the true F or H

DIAGONALS = 0.003  # of the image diagonal (Bian et al., BMVC 2019)


class InlierRate(NamedTuple):
    """Shares of true inliers among the matches given to the estimator and those it kept; NaN where there are none."""

    before: Tensor
    after: Tensor


@checked
def inlier_rate(
    F_gt: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"],
    inliers: Bool[Tensor, "*#batch n"], size0: Real[Tensor, "*#batch 2"], size1: Real[Tensor, "*#batch 2"], *,
    mask: Bool[Tensor, "*#batch n"] | None = None, threshold: float = DIAGONALS,
) -> InlierRate:  # fmt: skip
    """Inlier rate before and after estimation, float64: the paper's %Inlier-m and %Inlier as shares.

    Args:
        F_gt: true fundamental matrices, x1^T F x0 = 0 in pixels.
        x0, x1: the matches given to the estimator, in pixels.
        inliers: those that the estimator kept.
        size0, size1: image sizes as (h, w), pixels.
        mask: which of the matches count; all when not given.
        threshold: of `ground_truth_inliers`, in image diagonals.

    Raises:
        ValueError: a size is not positive.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import inlier_rate
        >>> F = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a sideways camera: epipolar lines are rows
        >>> x0 = torch.tensor([[100.0, 50], [200, 80], [300, 20]])
        >>> x1 = x0 + torch.tensor([[-9.0, 0], [-5, 0], [0, 40]])
        >>> size = torch.tensor([480, 640])
        >>> rate = inlier_rate(F, x0, x1, torch.tensor([True, True, False]), size, size)
        >>> round(rate.before.item(), 3), rate.after.item()
        (0.667, 1.0)
    """
    correct = ground_truth_inliers(F_gt, x0, x1, size0, size1, mask=mask, threshold=threshold)
    given = torch.ones_like(correct) if mask is None else mask.expand(correct.shape)
    kept = inliers & given
    return InlierRate(_share(correct, given), _share(correct & kept, kept))


@checked
def ground_truth_inliers(
    F_gt: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"],
    size0: Real[Tensor, "*#batch 2"], size1: Real[Tensor, "*#batch 2"], *,
    mask: Bool[Tensor, "*#batch n"] | None = None, threshold: float = DIAGONALS,
) -> Bool[Tensor, "*#batch n"]:  # fmt: skip
    """Matches whose two distances to their true epipolar lines are both below `threshold` image diagonals.

    No match is one where F_gt is zero or not finite.

    Args:
        F_gt, x0, x1, size0, size1, mask: as of `inlier_rate`.
        threshold: in diagonals of the image in which a distance is measured.

    Raises:
        ValueError: a size is not positive.
    """
    expect_sizes(size0=size0, size1=size1)
    F_gt, x0, x1 = (value.to(torch.float64) for value in (F_gt, x0, x1))
    d0, d1 = epipolar_distances(F_gt, x0, x1)
    limit0, limit1 = (threshold * diagonal(size.to(torch.float64))[..., None] for size in (size0, size1))
    known = (F_gt.isfinite().all(-1).all(-1) & (F_gt != 0).any(-1).any(-1))[..., None]
    correct = (d0 < limit0) & (d1 < limit1) & known
    return correct if mask is None else correct & mask


def _share(part: Tensor, total: Tensor) -> Tensor:
    return part.sum(-1).to(torch.float64) / total.sum(-1).to(torch.float64)


MATCH_THRESHOLD = 3.0  # px, of right matches, as LightGlue's table of HPatches (Lindenberger et al., ICCV 2023)


@checked
def right_of_homography(
    H_gt: Float[Tensor, "*#batch 3 3"], x0: Float[Tensor, "*#batch n 2"], x1: Float[Tensor, "*#batch n 2"], *,
    mask: Bool[Tensor, "*#batch n"] | None = None, threshold: float = MATCH_THRESHOLD,
) -> Bool[Tensor, "*#batch n"]:  # fmt: skip
    """Matches whose transfer distances under the true homography, in both images, have a mean below the threshold.

    Args:
        H_gt: true homographies, x1 ~ H x0 in pixels.
        x0, x1, mask: as of `inlier_rate`.
        threshold: px.
    """
    back, forth = homography_transfer(H_gt.to(torch.float64), x0.to(torch.float64), x1.to(torch.float64))
    right = (back + forth) / 2 < threshold
    return right if mask is None else right & mask
