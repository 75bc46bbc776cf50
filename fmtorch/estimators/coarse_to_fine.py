"""Coarse-to-Fine RANSAC: one estimator finds the inliers, another fits them (Bian et al., BMVC 2019, section 5)."""

from __future__ import annotations

from fmtorch.core.stages import Estimator
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.geometry.significance import judged


class CoarseToFine:
    """Two estimators in a row: the fine one sees the inliers of the coarse one, and its model is the estimate.

    A pair that one of them cannot solve is ``ok=False`` with that one's reason; `draws` counts those of both.
    Its significance is that among all matches, also those which the coarse one dropped.
    Gradients are the fine estimator's: the coarse one only chooses matches.

    Args:
        coarse: an estimator that prunes well, GC-RANSAC or USAC in the paper.
        fine: one that fits well, LMedS in the paper.
    """

    def __init__(self, *, coarse: Estimator, fine: Estimator) -> None:
        self.coarse, self.fine = coarse, fine

    @property
    def uses_prior(self) -> bool:
        """Whether a prior makes a difference to one of the two."""
        return any(getattr(stage, "uses_prior", False) for stage in (self.coarse, self.fine))

    @property
    def gradients_reach(self) -> tuple[str, ...]:
        """Those of the fine estimator."""
        return tuple(getattr(self.fine, "gradients_reach", ("x0", "x1", "prior", "noise")))

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        """Estimate the fundamental matrices of a batch of pairs."""
        coarse = self.coarse(c.detach(), seed)
        fine = self.fine(c.keep(coarse.inliers & coarse.ok[:, None]), seed)
        reasons = tuple(
            f"coarse: {first}" if first else f"fine: {second}" if second else ""
            for first, second in zip(coarse.reason, fine.reason, strict=True)
        )
        return judged(fine.replace(reason=reasons, samples=coarse.samples + fine.samples, significance=None), c)
