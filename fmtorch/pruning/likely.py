"""Keeping the matches that are likely to be right."""

from __future__ import annotations

import dataclasses

from fmtorch.core.types import Correspondences


@dataclasses.dataclass(frozen=True)
class Likely:
    """Keeps the matches whose ``prior``, P(inlier), is at least `min_probability`.

    It makes a filter of any stage that supplies a prior. Raises ValueError for correspondences without a prior.
    """

    min_probability: float = 0.5

    def __call__(self, correspondences: Correspondences) -> Correspondences:
        """The same matches, of which only likely ones survive; a prior that is NaN fails."""
        if correspondences.prior is None:
            raise ValueError("`likely` needs `prior`: put a stage that supplies it before, e.g. frame_consistency")
        return correspondences.keep(correspondences.prior >= self.min_probability)
