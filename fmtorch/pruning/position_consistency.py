"""P(inlier) from points alone: does each match move as its neighbours do?

The pair's common turn and change of scale are found first, so that the images may be rotated and zoomed; then each
match is compared with its neighbours along space-filling curves. Without frames this is nearly as telling as frame
consistency is with them: `scripts/calibrate_priors.py` has the figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair
from fmtorch.core.records import ungraphed
from fmtorch.core.types import Correspondences
from fmtorch.geometry.fixed_point import gradient_wanted
from fmtorch.pruning import position_consistency_kernels as compiled
from fmtorch.pruning.agreement import votes_of, with_gradient
from fmtorch.pruning.calibration import Calibration


def position_agreement(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    quality: Float[Tensor, "b n"] | None,
    mask: Bool[Tensor, "b n"],
) -> Float[Tensor, "b n"]:
    """The share of its neighbours' votes that agree with each match, in [0, 1]; zero where masked.

    For neighbours with differences dx0, dx1 and the common similarity S of the pair, of scale s,
    ``e = |S dx0 - dx1| / (s |dx0| + |dx1| + NOISE)``; the agreement is the mean of ``(1 + (e / TOLERANCE)^2 / 8)^-8``
    over the neighbours in both images, weighted by votes (`frame_agreement` has the same constants and votes). Computed
    in float32, on the CPU; differentiable in points and quality, S being a constant.
    """
    out = torch.empty(len(mask), mask.shape[1] + 3, dtype=torch.float32)
    out = for_each_pair(compiled.position_agreement, (x0, x1, quality, mask), out=out).to(x0.dtype)
    agreement, (a, b, _) = out[:, :-3], out[:, -3:].unbind(1)
    if not gradient_wanted(x0, x1, quality):
        return agreement
    S = torch.stack([a, -b, b, a], -1).reshape(-1, 1, 2, 2).expand(*mask.shape, 2, 2)
    return with_gradient(agreement, x0, x1, S, votes_of(quality, x0[..., 0]), mask)


class PositionConsistency:
    """Supplies ``prior``: P(inlier) from the agreement of neighbours' motion and, where known, the ratio.

    Needs no frames, no sizes and no quality. Linear memory: about 600 bytes a match.
    kernels: worth compiling together with those of an estimator.
    """

    kernels: ClassVar = (compiled.position_agreement,)

    def __init__(self, *, calibration: Mapping[str, Mapping[str, float]]) -> None:
        self.calibration = Calibration(**calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches with a prior."""
        return ungraphed(c, lambda: self.calibration(c, self.evidence(c)))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from."""
        return position_agreement(c.x0, c.x1, c.quality, c.mask)
