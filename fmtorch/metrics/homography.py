"""Errors of homographies ``x1 ~ H x0`` whose truth is known, as HPatches is evaluated."""

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from fmtorch.core.checks import checked, expect_sizes
from fmtorch.geometry.arithmetic import component_sum
from fmtorch.geometry.epipolar import inverse_root
from fmtorch.geometry.homography import homography_points, homography_transfer

MATCH_THRESHOLD = 3.0  # px, of right matches, as LightGlue's table of HPatches (Lindenberger et al., ICCV 2023)


@checked
def corner_error(
    H_est: Float[Tensor, "*#batch 3 3"], H_gt: Float[Tensor, "*#batch 3 3"], size0: Real[Tensor, "*#batch 2"]
) -> Float[Tensor, "*#batch"]:
    """Mean distance in image 1 between the corners of image 0 as two homographies map them (DeTone et al., 2018).

    Args:
        H_est, H_gt: the estimated and the true homography, x1 ~ H x0 in pixels, of any scale and sign.
        size0: of image 0, (h, w); its corners are the centres of its four corner pixels.

    Returns:
        Pixels, (...), float64; infinite where a corner has no finite image.

    Raises:
        ValueError: a size is not positive.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import corner_error
        >>> moved = torch.tensor([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
        >>> corner_error(moved, torch.eye(3), torch.tensor([480, 640])).item()
        5.0
    """
    expect_sizes(size0=size0)
    h, w = (size0.to(torch.float64) - 1).unbind(-1)
    zero = torch.zeros_like(h)
    corners = torch.stack([torch.stack(c, -1) for c in ((zero, zero), (w, zero), (w, h), (zero, h))], -2)
    a, b = (homography_points(H.to(torch.float64), corners) for H in (H_est, H_gt))
    finite = (torch.isfinite(a) & torch.isfinite(b)).all(-1)
    difference = torch.where(finite[..., None], a - b, 0.0)
    squared = component_sum(difference * difference, -1)
    return torch.where(finite.all(-1), component_sum(squared * inverse_root(squared), -1) / 4, torch.inf)


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
