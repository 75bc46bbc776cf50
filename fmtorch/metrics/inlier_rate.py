"""Matches that agree with the true F or H, and their share before and after estimation."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from fmtorch.core.checks import checked, expect_sizes
from fmtorch.geometry import epipolar_distances, homography_transfer
from fmtorch.metrics.nsgd import diagonal

THRESHOLD = 0.003  # of the image diagonal (Bian et al., BMVC 2019)


class InlierRate(NamedTuple):
    """Inlier rates of the matches given to the estimator and of those it kept; NaN where there are none."""

    before: Tensor
    after: Tensor


@checked
def inlier_rate(
    F_gt: Float[Tensor, "*#batch 3 3"],
    x0: Float[Tensor, "*#batch n 2"],
    x1: Float[Tensor, "*#batch n 2"],
    inliers: Bool[Tensor, "*#batch n"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    threshold: float = THRESHOLD,
) -> InlierRate:
    """Inlier rate before and after estimation: the paper's %Inlier-m and %Inlier as shares.

    Args:
        F_gt: true fundamental matrices, x1^T F x0 = 0 in pixels.
        x0, x1: the matches given to the estimator, in pixels.
        inliers: those that the estimator kept.
        size0, size1: image sizes as (h, w), pixels.
        mask: which of the matches count; all when not given.
        threshold: of `ground_truth_inliers`, in image diagonals.

    Returns:
        Shares of ground-truth inliers (...), float64: `before`, among the matches in `mask`, and `after`, among those
        of them that are in `inliers`. NaN where there are none.

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
    F_gt: Float[Tensor, "*#batch 3 3"],
    x0: Float[Tensor, "*#batch n 2"],
    x1: Float[Tensor, "*#batch n 2"],
    size0: Real[Tensor, "*#batch 2"],
    size1: Real[Tensor, "*#batch 2"],
    *,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    threshold: float = THRESHOLD,
) -> Bool[Tensor, "*#batch n"]:
    """Matches whose two distances to their true epipolar lines are both below `threshold` image diagonals.

    Args:
        F_gt, x0, x1, size0, size1, mask: as of `inlier_rate`.
        threshold: in diagonals of the image in which a distance is measured.

    Returns:
        (..., N). No match is an inlier where F_gt is zero or not finite.

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
    H_gt: Float[Tensor, "*#batch 3 3"],
    x0: Float[Tensor, "*#batch n 2"],
    x1: Float[Tensor, "*#batch n 2"],
    *,
    mask: Bool[Tensor, "*#batch n"] | None = None,
    threshold: float = MATCH_THRESHOLD,
) -> Bool[Tensor, "*#batch n"]:
    """Matches whose transfer distances under the true homography, in both images, have a mean below the threshold.

    Args:
        H_gt: true homographies, x1 ~ H x0 in pixels.
        x0, x1: matches in pixels.
        mask: which of the matches count; all when not given.
        threshold: px.

    Returns:
        (..., N).
    """
    back, forth = homography_transfer(H_gt.to(torch.float64), x0.to(torch.float64), x1.to(torch.float64))
    right = (back + forth) / 2 < threshold
    return right if mask is None else right & mask
