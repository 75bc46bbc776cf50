"""CODE: coherence-based decision boundaries (Lin et al., TPAMI 2018)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.core.types import Correspondences
from fmtorch.pruning.code.domain import finite_matches, match_domain
from fmtorch.pruning.code.likelihood import LikelihoodField
from fmtorch.pruning.code.motion import SmoothMotion

MIN_LIKELIHOOD, LARGEST_RESIDUAL = 0.5, 0.06


class Coherence(NamedTuple):
    """How coherent each match is.

    likelihood: near 1 for a match that agrees with many distinctive ones, near 0 or below otherwise.
    residual: distance of its partner from the smooth motion of the likely matches, in units of the root mean square
    coordinate in image 1; infinite where there is no motion. Zero and infinite for what is no match.
    """

    likelihood: Float[Tensor, "b n"]
    residual: Float[Tensor, "b n"]


def code(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    mask: Bool[Tensor, "b n"] | None = None,
    quality: Float[Tensor, "b n"] | None = None,
    lafs0: Float[Tensor, "b n 2 3"] | None = None,
    lafs1: Float[Tensor, "b n 2 3"] | None = None,
    least_likelihood: float = MIN_LIKELIHOOD,
    largest_residual: float = LARGEST_RESIDUAL,
    likelihood: LikelihoodField | None = None,
    motion: SmoothMotion | None = None,
) -> Bool[Tensor, "b n"]:
    """True for matches that are likely and follow the smooth motion of the likely ones; see `coherence`."""
    result = coherence(
        x0, x1, mask=mask, quality=quality, lafs0=lafs0, lafs1=lafs1,
        least_likelihood=least_likelihood, likelihood=likelihood, motion=motion,
    )  # fmt: skip
    return (result.likelihood > least_likelihood) & (result.residual < largest_residual)


@torch.no_grad()
def coherence(
    x0: Float[Tensor, "b n 2"],
    x1: Float[Tensor, "b n 2"],
    *,
    mask: Bool[Tensor, "b n"] | None = None,
    quality: Float[Tensor, "b n"] | None = None,
    lafs0: Float[Tensor, "b n 2 3"] | None = None,
    lafs1: Float[Tensor, "b n 2 3"] | None = None,
    least_likelihood: float = MIN_LIKELIHOOD,
    likelihood: LikelihoodField | None = None,
    motion: SmoothMotion | None = None,
) -> Coherence:
    """The likelihood of each match and its distance from the smooth motion of those above `least_likelihood`.

    Two robust regressions on radial basis functions, as in CODE; our form differs from the authors' in that the
    centres are chosen where distinctive matches crowd, and that each predicts its neighbours' displacement by its
    frame. Points in pixels or any unit; `quality` is the distance ratio. Matches that are not finite or have a
    degenerate frame are none. Every pair is computed from its own matches alone; memory is linear in their number.
    Not differentiable.
    """
    finite = finite_matches(x0, x1, lafs0, lafs1)
    mask = finite if mask is None else finite & mask
    likelihood, motion = likelihood or LikelihoodField(), motion or SmoothMotion()
    result = Coherence(torch.zeros(mask.shape, device=x0.device), torch.full(mask.shape, math.inf, device=x0.device))
    for pair, here in enumerate(mask):
        if not bool(here.any()):
            continue
        ratios, frames0, frames1 = (None if v is None else v[pair][here] for v in (quality, lafs0, lafs1))
        matches = match_domain(x0[pair][here], x1[pair][here], frames0, frames1)
        result.likelihood[pair, here] = f = likelihood(
            matches, ratios, framed=frames0 is not None and frames1 is not None
        )
        result.residual[pair, here] = motion(matches, f > least_likelihood)
    return result


class CODE:
    """`code` as a stage, which also supplies ``prior``: P(inlier).

    The odds are ``odds (max(likelihood, 0) + floor)^3 / (1 + (residual / reach)^2)``. soft: True keeps every match
    and gives the prior only. likelihood, motion: options of `LikelihoodField` and `SmoothMotion`.
    """

    def __init__(
        self,
        *,
        odds: float,
        floor: float,
        reach: float,
        least_likelihood: float = MIN_LIKELIHOOD,
        largest_residual: float = LARGEST_RESIDUAL,
        soft: bool = False,
        likelihood: Mapping[str, Any] | None = None,
        motion: Mapping[str, Any] | None = None,
    ) -> None:
        self.odds, self.floor, self.reach, self.soft = odds, floor, reach, soft
        self.least_likelihood, self.largest_residual = least_likelihood, largest_residual
        self.likelihood, self.motion = LikelihoodField(**(likelihood or {})), SmoothMotion(**(motion or {}))

    def __call__(self, c: Correspondences) -> Correspondences:
        """The same matches, of which only the coherent ones survive, with a prior."""
        result = coherence(
            c.x0, c.x1, mask=c.mask, quality=c.quality, lafs0=c.lafs0, lafs1=c.lafs1,
            least_likelihood=self.least_likelihood, likelihood=self.likelihood, motion=self.motion,
        )  # fmt: skip
        evidence = result.likelihood.clamp_min(0) + self.floor
        odds = self.odds * evidence * evidence * evidence / (1 + (result.residual / self.reach).square())
        c = c.replace(prior=(odds / (1 + odds)).to(c.x0.dtype))
        if self.soft:
            return c
        return c.keep((result.likelihood > self.least_likelihood) & (result.residual < self.largest_residual))
