"""Sizes of images that nobody gave, assumed from the extent of their matched points: keypoints reach near the border.

Two images mostly come from one camera, so that the farther point of both tells the size of either. Where their extents
differ by more than that, two sizes are tried as well, and the estimate that is more significant is taken.

On castle-P19 and fox (every fourth pair, SIFT, ratios given) AUC@0.05 of F is 52.7 without sizes, 71.6 with the true
ones and 73.1 with these; with matches in the upper left, the lower right and the right part of image 0 alone 50.5, 34.9
and 33.0 without, 61.6, 51.2 and 55.9 with the true ones, 58.6, 52.5 and 56.4 with these; with image 1 at 0.7 of its
size 54.3, 68.1 and 64.6, and upright beside a lying one 53.4, 65.3 and 62.2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.two_view.arguments import MIN_PIXELS, Arrays

Size = Arrays | Literal["unknown"] | None
MIN_MATCHES = 20  # fewer say little of where an image ends
BORDER = -1.0  # px: coordinates below are not those of a photograph
MARGIN = 1.5  # of the extent over the number of points, by which the last point of evenly spread ones is off the border
SAME_SIZE = 1.1  # ratio of extents up to which images have one size
TWO_SIZES_GAIN = 3.0  # of significance, from which on images have two


def given_sizes(size0: Size, size1: Size) -> tuple[Arrays | None, Arrays | None, bool]:
    """Sizes as `Correspondences` has them, and whether they may be assumed: they are neither given nor "unknown"."""
    for name, size in (("size0", size0), ("size1", size1)):
        if isinstance(size, str) and size != "unknown":
            raise ValueError(f"{name} is {size!r}; it must be (h, w), 'unknown' or None")
    if (size0 == "unknown") if isinstance(size0, str) else isinstance(size1, str):
        known = [name for name, size in (("size0", size0), ("size1", size1)) if not isinstance(size, str | None)]
        if known:
            raise ValueError(
                f"{known[0]} is given and the other is 'unknown'; give the sizes of both images, or neither"
            )
        return None, None, False
    assert not isinstance(size0, str)
    assert not isinstance(size1, str)
    return size0, size1, size0 is None and size1 is None


def extents(c: Correspondences) -> tuple[Float[Tensor, "b 2 2"], Bool[Tensor, " b"]]:
    """Sizes (h, w) of images whose points spread evenly up to the border, and of which pairs these tell any: of those
    whose points look like a photograph's. Centred, normalised and undistorted points have negative coordinates."""
    x = torch.cat([c.x0, c.x1], -1).detach().double()
    there = (c.mask & x.isfinite().all(-1))[..., None]
    count = there.sum(1).to(x)
    if not x.shape[1]:
        return x.new_full((len(c), 2, 2), torch.nan), count[:, 0] > 0
    first, last = torch.where(there, x, torch.inf).amin(1), torch.where(there, x, -torch.inf).amax(1)
    known = (count >= MIN_MATCHES)[:, 0] & (first > BORDER).all(1) & (last > MIN_PIXELS).all(1)
    sizes = last * (1 + MARGIN / count.clamp_min(1)) + 0.5
    return torch.where(known[:, None], sizes, torch.nan).reshape(-1, 2, 2).flip(-1), known


def with_assumed_sizes(c: Correspondences, estimate: Callable[[Correspondences], Estimate]) -> Estimate:
    """The better estimate of each pair, with `sizes` and `sizes_doubtful`. estimate: of a batch, with significance.
    It is made of pairs without sizes, of pairs of one size, and again of two where that is doubtful."""
    own, known = extents(c)
    same = own.amax(1, keepdim=True).expand(-1, 2, -1)
    doubtful = known & (same > SAME_SIZE * own).flatten(1).any(1)
    kinds = [(known, same), (~known, own), (doubtful, own)]
    tried = [(rows, sizes) for rows, sizes in kinds if bool(rows.any())] or kinds[1:2]
    together = collate([estimate(_sized(c, rows, sizes)) for rows, sizes in tried])
    row = torch.cat([rows.nonzero()[:, 0] for rows, _ in tried])
    place = torch.argsort(row[: len(c)])
    second = torch.arange(len(c), len(row), device=row.device)  # of the doubtful ones, of two sizes
    significance = cast(Tensor, together.significance)
    better = together.ok[second] & ~(significance[second] - significance[place[doubtful]] <= TWO_SIZES_GAIN)
    place = place.masked_scatter(doubtful, torch.where(better, second, place[doubtful]))
    sizes = torch.cat([sizes[rows] for rows, sizes in tried])
    return together[place].derived(sizes=sizes[place], sizes_doubtful=doubtful)


def _sized(c: Correspondences, rows: Tensor, sizes: Tensor) -> Correspondences:
    """Some pairs of a batch with their sizes, as they are where there are none."""
    c, sizes = (c, sizes) if bool(rows.all()) else (c[rows], sizes[rows])
    return c.derived(size0=sizes[:, 0], size1=sizes[:, 1]) if bool(sizes.isfinite().all()) else c
