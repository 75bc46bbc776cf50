"""From a pruner's evidence to P(inlier)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.types import Correspondences

_SQUARINGS = 10
_LARGEST = 12.0  # log-odds beyond which P(inlier) is as good as 0 or 1; the logistic function here is 6e-6 off 1 there


def logistic(z: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``o / (1 + o)`` with ``o = (1 + z / 1024)^1024``, the logistic function but for 0.001 at most.

    Made of arithmetic alone, whose last bits, unlike those of exp, do not depend on where in memory a number stands;
    in float64, since the power multiplies a rounding error by 1024. The result has the type of z.
    """
    odds: Tensor = 1 + z.clamp(-_LARGEST, _LARGEST).double() / 2**_SQUARINGS
    for _ in range(_SQUARINGS):
        odds = odds.square()
    return (odds / (odds + 1)).to(z.dtype)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """``P(inlier) = logistic(constant + evidence e + ratio q)`` of the evidence e and the distance ratio q.

    with_ratio: {constant, evidence, ratio}, where matches have a `ratio`. alone: {constant, evidence}, where they
    have none; without it their prior stays as it is. `scripts/calibrate_priors.py` fits these numbers.
    """

    with_ratio: Mapping[str, float]
    alone: Mapping[str, float] | None = None

    def __call__(self, c: Correspondences, evidence: Float[Tensor, "b n"]) -> Correspondences:
        """The same matches with ``prior``, zero where masked. A ratio that is NaN counts as 1. Log-odds are float32."""
        fitted = self.alone if c.ambiguity is None else self.with_ratio
        if fitted is None:
            return c
        log_odds = fitted["constant"] + fitted["evidence"] * torch.where(c.mask, evidence.float(), 0)
        if c.ambiguity is not None:
            log_odds = log_odds + fitted["ratio"] * torch.where(c.mask, c.ambiguity.float(), 0).nan_to_num(nan=1.0)
        return c.derived(prior=torch.where(c.mask, logistic(log_odds), 0).to(c.x0.dtype))


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
        """The same matches with a prior."""
        return self.calibration(c, self.evidence(c))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """None but the ratio."""
        return torch.zeros_like(c.x0[..., 0])
