"""Locality preserving matching: LPM (Ma et al., IJCV 2019)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.compiling.batches import for_each_pair
from fmtorch.core.types import Correspondences
from fmtorch.pruning import lpm_kernels as compiled
from fmtorch.pruning.calibration import calibration_of


def lpm(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    mask: Bool[Tensor, "b n"] | None = None,
    thresholds: Sequence[float] = (0.8, 0.5),
    neighbors: Sequence[int] = (6, 6),
    taus: Sequence[float] = (0.2, 0.2),
) -> Bool[Tensor, "b n"]:
    """True for matches whose neighbourhoods in the two images hold the same matches, moving alike.

    The cost of a match is the mean over three neighbourhood sizes (K + 2, K, K - 2) of the share of its neighbours
    that are near in one image only or whose motion differs, ``cos(angle) * ratio of squared lengths < tau``. Two
    passes, each with its threshold lambda, K and tau: the second seeks neighbours among the matches that the first
    kept, if those are at least K + 4, and decides. Equal to the released code with exact neighbours, ties by index; a
    neighbour that does not exist, where matches are few, counts as lost.

    Points in any common unit. Non-finite points are dropped. Memory is linear in the number of matches. Computed on
    the CPU. Raises ValueError for K below 4, and for options of different lengths.
    """
    return _kept_and_cost(x0, x1, mask, _passes(thresholds, neighbors, taus))[:, 0] > 0


def lpm_cost(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    mask: Bool[Tensor, "b n"] | None = None,
    thresholds: Sequence[float] = (0.8, 0.5),
    neighbors: Sequence[int] = (6, 6),
    taus: Sequence[float] = (0.2, 0.2),
) -> Float[Tensor, "b n"]:
    """The mean of the costs of the passes of `lpm`, in [0, 1]; 1 for masked matches and non-finite points.

    The first pass sees all matches, the second those that the first kept: together they tell right matches from wrong
    ones better than either does. Arguments as `lpm`.
    """
    return _kept_and_cost(x0, x1, mask, _passes(thresholds, neighbors, taus))[:, 1].to(x0.dtype)


def _kept_and_cost(x0: Tensor, x1: Tensor, mask: Tensor | None, passes: compiled.Passes) -> Float[Tensor, "b 2 n"]:
    """Of each match 1 if it is kept, and its cost."""
    mask = torch.ones_like(x0[..., 0], dtype=torch.bool) if mask is None else mask
    out = torch.empty(len(x0), 2, x0.shape[1], dtype=torch.float64)
    return for_each_pair(compiled.lpm, (x0, x1, mask), passes, out=out, kind=torch.float64)


def _passes(thresholds: Sequence[float], neighbors: Sequence[int], taus: Sequence[float]) -> compiled.Passes:
    """The options by pass; raises ValueError where they do not belong together."""
    counts = {"thresholds": len(thresholds), "neighbors": len(neighbors), "taus": len(taus)}
    if len(set(counts.values())) > 1 or not thresholds:
        said = ", ".join(f"{name} has {count}" for name, count in counts.items())
        raise ValueError(f"{said} values; they must have one for each pass, and there must be a pass")
    if min(neighbors) < 4:
        raise ValueError(f"neighbors is {neighbors}; each must be at least 4, so that the smallest neighbourhood has 2")
    return compiled.Passes(np.array(thresholds, float), np.array(neighbors, np.int64), np.array(taus, float))


class LPM:
    """`lpm` as a stage; or, `soft`, a stage that keeps every match and supplies ``prior``: P(inlier) by `lpm_cost`.

    `thresholds`, `neighbors`, `taus` hold one value for each of the two passes. calibration: of one minus the cost, see
    `Calibration`; needed by the soft form alone, which raises ValueError without it.
    """

    def __init__(
        self,
        *,
        thresholds: Sequence[float] = (0.8, 0.5),
        neighbors: Sequence[int] = (6, 6),
        taus: Sequence[float] = (0.2, 0.2),
        soft: bool = False,
        calibration: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        self._options: dict[str, Any] = {"thresholds": thresholds, "neighbors": neighbors, "taus": taus}
        self.calibration = calibration_of("LPM", soft, calibration)

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only those survive that keep their neighbourhoods, or with a prior."""
        if self.calibration is not None:
            return self.calibration(c, self.evidence(c))
        return c.keep(lpm(c.x0, c.x1, mask=c.mask, **self._options))

    def evidence(self, c: Correspondences) -> Float[Tensor, "b n"]:
        """What the prior is calibrated from: one minus the cost."""
        return 1 - lpm_cost(c.x0, c.x1, mask=c.mask, **self._options)
