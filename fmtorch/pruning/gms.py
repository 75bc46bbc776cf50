"""Grid-based motion statistics: GMS (Bian et al., CVPR 2017)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair
from fmtorch.core.types import Correspondences
from fmtorch.pruning import gms_kernels as compiled
from fmtorch.pruning.calibration import calibration_of

Border = Literal["opencv", "authors"]
# Cells a side in image 1 at the scale ratios 1, 1/2, 1/sqrt(2), sqrt(2), 2, rounded down as the released code does.
GRIDS = (20, 10, 14, 28, 40)


def gms(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    size0: Int[Tensor, "b 2"],
    size1: Int[Tensor, "b 2"],
    mask: Bool[Tensor, "b n"] | None = None,
    with_rotation: bool = False,
    with_scale: bool = False,
    threshold_factor: float = 6.0,
    border: Border = "opencv",
) -> Bool[Tensor, "b n"]:
    """True for matches whose neighbours move with them, as counted on coarse grids.

    Each of four shifted 20 x 20 grids in image 0 assigns every cell the cell of image 1 that most of its matches go
    to; the assignment stands when the nine cells around move likewise often enough,
    ``score >= threshold_factor * sqrt(mean matches of the nine cells)``. A match is kept when it
    follows the assignment of its cell in one of the grids. with_rotation tries eight rotations of the neighbourhood,
    with_scale five sizes of the grid in image 1; the hypothesis that keeps most matches wins, the first of equals.

    x0, x1 in pixels, size0, size1 as (h, w). Matches outside their images' grids are dropped. Masks equal those of
    OpenCV's matchGMS; border="authors" gives those of the authors' code, which drops points in the left and top half
    cells of shifted grids. Time and memory are linear in the number of matches, besides a table of cell pairs. Computed
    on the CPU.
    """
    tensors, options = _given(x0, x1, size0, size1, mask), _options(with_rotation, with_scale, threshold_factor, border)
    out = torch.empty(x0.shape[:2], dtype=torch.bool)
    return for_each_pair(compiled.gms, tensors, *options, out=out, kind=torch.float64, group=compiled.Matches)


def gms_support(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    size0: Int[Tensor, "b 2"],
    size1: Int[Tensor, "b 2"],
    mask: Bool[Tensor, "b n"] | None = None,
    with_rotation: bool = False,
    with_scale: bool = False,
    threshold_factor: float = 6.0,
    border: Border = "opencv",
) -> Float[Tensor, "b n"]:
    """How many neighbours move with each match, against how many would suffice by the square root; in [0, 1).

    In each of the four grids, ``z = (score - 1) / sqrt(mean matches of the nine cells, at least 1)``, where the score
    counts the matches, itself included, of the nine cells around that go where the match's own cells say: the paper's
    S_i for each match instead of for the assignment of its cell. The support is ``z / (z + 1.5)`` of the mean z over
    the grids; 0 for a match that is alone, outside or masked. Rotation and scale are those of the hypothesis that keeps
    most matches of the pair in `gms`, whose arguments these are.
    """
    tensors, options = _given(x0, x1, size0, size1, mask), _options(with_rotation, with_scale, threshold_factor, border)
    out = torch.empty(x0.shape[:2], dtype=torch.float64)
    for_each_pair(compiled.gms_support, tensors, *options, out=out, kind=torch.float64, group=compiled.Matches)
    return out.to(x0)


def _given(x0: Tensor, x1: Tensor, size0: Tensor, size1: Tensor, mask: Tensor | None) -> tuple[Tensor, ...]:
    """What the kernels are given of each pair."""
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    return x0, x1, size0.float(), size1.float(), mask


def _options(with_rotation: bool, with_scale: bool, threshold_factor: float, border: Border) -> tuple[Any, ...]:
    """What they are given of all pairs: sides of the grids in image 1, rotations, factor, whose rule at the border."""
    return (
        np.array(GRIDS if with_scale else GRIDS[:1]),
        8 if with_rotation else 1,
        threshold_factor,
        border == "authors",
    )


class GMS:
    """`gms` as a stage; or, `soft`, a stage that keeps every match and supplies ``prior``: P(inlier) by `gms_support`.

    calibration: of the support, see `Calibration`; needed by the soft form alone. The other options are those of `gms`.
    Raises ValueError for the soft form without a calibration, and for correspondences without image sizes.
    """

    def __init__(
        self,
        *,
        with_rotation: bool = False,
        with_scale: bool = False,
        threshold_factor: float = 6.0,
        border: Border = "opencv",
        soft: bool = False,
        calibration: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        self.with_rotation, self.with_scale = with_rotation, with_scale
        self.threshold_factor, self.border = threshold_factor, border
        self.calibration = calibration_of("GMS", soft, calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that move with their neighbours, or with a prior."""
        return self.calibration(c, self.evidence(c)) if self.calibration else c.keep(gms(**self._arguments(c)))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from: `gms_support`."""
        return gms_support(**self._arguments(c))

    def _arguments(self, c: Correspondences) -> dict[str, Any]:
        if c.size0 is None or c.size1 is None:
            raise ValueError("GMS needs `size0` and `size1`: its grids divide the images")
        return {
            "x0": c.x0, "x1": c.x1, "size0": c.size0, "size1": c.size1, "mask": c.mask,
            "with_rotation": self.with_rotation, "with_scale": self.with_scale,
            "threshold_factor": self.threshold_factor, "border": self.border,
        }  # fmt: skip
