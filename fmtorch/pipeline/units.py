"""Whether points are in pixels, as thresholds take them: normalised ones would all be inliers of any model."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences

MIN_PIXELS = 10.0  # a photograph's points reach farther from its first pixel
MIN_MATCHES = 8  # fewer say nothing of their unit
MAX_OUTSIDE = (
    0.5  # share of points outside an image of the given size, such as points undistorted far beyond its border
)
SWAPPED = 0.05  # share outside from which on a size is taken for (w, h), if all points are inside then


def expect_pixels(c: Correspondences) -> None:
    """Raise ValueError where the points of all pairs are obviously not in pixels, or contradict the image sizes.

    Of a batch in which some pairs are sound none is refused: no pair can take its batch down. Points of an image with a
    calibration matrix may be in its unit, whatever that is.
    """
    for i, (x, K, size) in enumerate(((c.x0, c.K0, c.size0), (c.x1, c.K1, c.size1))):
        x = x.detach()
        mask = c.mask & torch.isfinite(x).all(-1)
        enough = mask.sum(1) >= MIN_MATCHES
        if not bool(enough.any()):
            continue
        if bool(_normalized(x, mask, K)[enough].all()):
            _refuse(x, mask, i, K is not None)
        if size is not None:
            _expect_inside(x[enough], mask[enough], size.detach()[enough], i)


def _normalized(x: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"], K: Tensor | None) -> Bool[Tensor, " b"]:
    """Whether all coordinates of a pair are too small for pixels, and not all are zero."""
    reach = torch.where(mask[..., None], x.abs(), 0).flatten(1).amax(1)
    small = (reach > 0) & (reach < MIN_PIXELS)
    if K is None:
        return small
    focal = K.detach().to(reach.device)[:, (0, 1), (0, 1)].abs().amax(1)
    return small & (focal > 10 * MIN_PIXELS)


def _refuse(x: Tensor, mask: Tensor, i: int, calibrated: bool) -> None:
    """Raise ValueError that says what the points are and what to do."""
    inside = x[mask]
    span = f"from {inside.min():.3g} to {inside.max():.3g}"
    if calibrated:
        raise ValueError(
            f"x{i} runs {span}, as normalised points do, but K{i} is in pixels; give points in pixels, or normalised "
            f"ones with K{i} the identity"
        )
    raise ValueError(
        f"x{i} runs {span}: no pixels, in which thresholds are, so that every match would be an inlier. Give points in "
        "pixels (times the focal length), or normalised ones to find_essential with K0 and K1 the identity"
    )


def _expect_inside(x: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"], size: Tensor, i: int) -> None:
    """Raise ValueError where the points of all pairs contradict the image's size (b, 2), h and w."""
    far = _outside(x, mask, size.flip(-1))
    swapped = (far > SWAPPED) & (_outside(x, mask, size) == 0)
    if not bool(((far > MAX_OUTSIDE) | swapped).all()):
        return
    h, w = size[0].tolist()
    hint = "; sizes are (h, w), and it looks like (w, h)" if bool(swapped[0]) else "; sizes are (h, w) in pixels"
    raise ValueError(
        f"size{i} is ({h:g}, {w:g}), but {100 * float(far[0]):.0f} % of x{i} lie outside such an image{hint}"
    )


def _outside(x: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"], width_height: Tensor) -> Float[Tensor, " b"]:
    """The share of points beyond the border, of the first pixel's centre and of the last one's, by a pixel."""
    limit = width_height.to(x.device)[:, None]
    beyond = ((x < -1) | (x > limit)).any(-1) & mask
    return beyond.sum(1) / mask.sum(1)
