"""From a pruner's evidence to P(inlier)."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.geometry.arithmetic import gradient_wanted
from fmtorch.jit.batches import for_each_pair
from fmtorch.jit.kernel import B1x1, F4x1, inner, kernel

_SQUARINGS = 10
_LARGEST = 12.0  # log-odds beyond which P(inlier) is as good as 0 or 1; the logistic function here is 6e-6 off 1 there


@inner
def logistic(z: Any) -> Any:
    """``o / (1 + o)`` with ``o = (1 + z / 1024)^1024``, the logistic function but for 0.001 at most. Of tensors, too.
    Made of arithmetic alone, whose last bits, unlike those of exp, do not depend on where in memory a number stands. z:
    float64, since the power multiplies a rounding error by 1024; between -1024 and 1024."""
    odds = 1 + z / 2**_SQUARINGS
    for _ in range(_SQUARINGS):
        odds = odds * odds
    return odds / (odds + 1)


@kernel
def calibrated(evidence: F4x1, ratio: F4x1, mask: B1x1, numbers: F4x1, out: F4x1) -> None:
    """P(inlier) of `Calibration` from evidence and ratio (n,) -> out (n,); zero where masked.
    ratio: empty where unknown. numbers: constant, weights of evidence and ratio."""
    for i in range(len(mask)):
        z = numbers[0] + numbers[1] * evidence[i]
        if len(ratio):
            z += numbers[2] * (np.float32(1) if np.isnan(ratio[i]) else ratio[i])
        out[i] = logistic(min(max(np.float64(z), -_LARGEST), _LARGEST)) if mask[i] else 0.0


@dataclasses.dataclass(frozen=True)
class Calibration:
    """``P(inlier) = logistic(constant + evidence e + ratio q)`` of the evidence e and the distance ratio q.
    with_ratio: {constant, evidence, ratio}, where matches have a `ratio`. alone: {constant, evidence}, where they have
    none; without it their prior stays as it is. `scripts/calibrate_priors.py` fits these numbers."""

    with_ratio: Mapping[str, float]
    alone: Mapping[str, float] | None = None

    def __call__(self, c: Correspondences, evidence: Float[Tensor, "b n"]) -> Correspondences:
        """The same matches with ``prior``, zero where masked. A ratio that is NaN counts as 1. Computed in float32."""
        ratio = c.ambiguity
        fitted = self.alone if ratio is None else self.with_ratio
        if fitted is None:
            return c
        numbers = np.array([fitted["constant"], fitted["evidence"], fitted.get("ratio", 0.0)], np.float32)
        out = torch.empty(c.mask.shape, dtype=torch.float32)
        prior = for_each_pair(calibrated, (evidence, ratio, c.mask), numbers, out=out)
        if gradient_wanted(evidence, ratio):
            z = fitted["constant"] + fitted["evidence"] * torch.where(c.mask, evidence, 0)
            if ratio is not None:
                z = z + fitted["ratio"] * torch.where(c.mask, ratio, 0).nan_to_num(nan=1.0)
            z = z.clamp(-_LARGEST, _LARGEST)
            slope = prior * (1 - prior) / (1 + z.detach() / 2**_SQUARINGS)
            prior = prior + slope * (z - z.detach())  # adds zeros
        return c.derived(prior=prior.to(c.x0.dtype))


def calibration_of(
    pruner: str, soft: bool, calibration: Mapping[str, Mapping[str, float]] | None
) -> Calibration | None:
    """The calibration of a stage that is `soft`; None of one that prunes. Raises ValueError where it is missing."""
    if not soft:
        return None
    if calibration is None:
        raise ValueError(f"{pruner} with soft=true needs `calibration`, to supply a prior; it would do nothing")
    return Calibration(**calibration)


class RatioPrior:
    """Supplies ``prior``: P(inlier) from the distance ratio alone. Without `ratio` the prior stays as it is."""

    def __init__(self, *, calibration: Mapping[str, Mapping[str, float]]) -> None:
        self.calibration = Calibration(**calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        return self.calibration(c, self.evidence(c))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """None but the ratio."""
        return torch.zeros_like(c.x0[..., 0])
