"""What a pruner is trained for: the sum of a classification loss, a geometric loss and NSGD itself."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch.geometry.eight_point import eight_point
from fmtorch.pipeline.labelled import LabelledMatches
from fmtorch.pruning.networks.learned import Prediction
from fmtorch.training.pruner_losses import classification_loss, geometric_loss, nsgd_loss

COORDINATES = ("size", "K")


@dataclasses.dataclass(frozen=True)
class Objective:
    """The loss of a batch, as a sum of terms that a config weighs; every stage of the network is supervised.

    Attributes:
        classification: weight of the cross-entropy of P(inlier) (Yi et al., CVPR 2018, eq. 7, without class balance).
        geometric: weight of the symmetric epipolar distance of virtual points of the true geometry to the weighted
            8-point fit (Ranftl & Koltun, ECCV 2018; clamped as by Zhang et al., ICCV 2019).
        nsgd: weight of NSGD between that fit and the truth, in image diagonals.
        nsgd_limit: of a pair's NSGD, beyond which it has no gradient.
        coordinates: the unit of the geometric loss, "size" (half the longest side) or "K" (focal lengths).
        classification_steps: steps of classification alone, before the other two terms come in.
        points: virtual points of a pair.
    """

    classification: float = 1.0
    geometric: float = 0.5
    nsgd: float = 0.0
    nsgd_limit: float | None = 0.2
    coordinates: str = "size"
    classification_steps: int = 500
    points: int = 100

    def __post_init__(self) -> None:
        if self.coordinates not in COORDINATES:
            raise ValueError(f"objective.coordinates={self.coordinates}; it must be one of: {', '.join(COORDINATES)}")
        if min(self.classification, self.geometric, self.nsgd, self.classification_steps) < 0 or self.points < 1:
            raise ValueError("objective: weights and classification_steps must not be negative, points at least 1")
        if not max(self.classification, self.geometric, self.nsgd) > 0:
            raise ValueError("objective: at least one of classification, geometric and nsgd must have a weight")

    def __call__(self, prediction: Prediction, batch: LabelledMatches, step: int) -> dict[str, Float[Tensor, ""]]:
        """The terms of the loss, unweighted, and their weighted sum `loss`.

        Args:
            prediction: of the network, for the batch's correspondences.
            batch: labelled matches; pairs without labels, or whose fit is not determined, add nothing.
            step: optimisation steps done so far.

        Returns:
            A scalar for each term that counts at this step, and `loss`. Gradients are finite for every batch.
        """
        terms = {}
        if self.classification:
            terms["classification"] = classification_loss(prediction.logit, batch.label)
        if step >= self.classification_steps and (self.geometric or self.nsgd):
            F, valid = fits(prediction, batch)
            c = batch.correspondences
            if c.size0 is None or c.size1 is None:
                raise ValueError("the geometric losses need image sizes (size0, size1) of every pair")
            if self.geometric:
                calibrated = self.coordinates == "K"
                if calibrated and (c.K0 is None or c.K1 is None):
                    raise ValueError("objective.coordinates=K needs calibration matrices; the data set has none")
                terms["geometric"] = geometric_loss(
                    F, batch.F, c.size0, c.size1, K0=c.K0 if calibrated else None, K1=c.K1 if calibrated else None,
                    valid=valid, points=self.points, seed=step, key=c.keys,
                )  # fmt: skip
            if self.nsgd:
                terms["nsgd"] = nsgd_loss(
                    F, batch.F, c.size0, c.size1, valid=valid, limit=self.nsgd_limit, samples=self.points, seed=step,
                    key=c.keys,
                )  # fmt: skip
        weights = {"classification": self.classification, "geometric": self.geometric, "nsgd": self.nsgd}
        total = 0 * prediction.logit.sum()
        for name, value in terms.items():
            total = total + weights[name] * value.to(total.dtype)
        return {**terms, "loss": total}


def fits(
    prediction: Prediction, batch: LabelledMatches
) -> tuple[Float[Tensor, "stages b 3 3"], Bool[Tensor, "stages b"]]:
    """The fundamental matrices of each stage in pixels, and which are valid: the network's own, or weighted 8-point."""
    c = batch.correspondences
    if prediction.F is not None:
        F = prediction.F
        return F, torch.isfinite(F.detach()).flatten(-2).all(-1) & (F.detach() != 0).flatten(-2).any(-1)
    x0, x1 = (x.to(torch.float64).expand(len(prediction.weight), *x.shape) for x in (c.x0, c.x1))
    return eight_point(x0, x1, prediction.weight.to(torch.float64), c.mask.expand(prediction.weight.shape))
