"""kornia's RANSAC."""

import kornia
import numpy as np
import torch

from fmtorch.estimators.external.pairwise import Confidence, Pair, PairwiseEstimator, Solution


def kornia_ransac(
    *,
    threshold: float = 1.0,
    confidence: Confidence = 0.9999,
    batch_size: int = 2048,
    rounds: int = 10,
    prosac: bool = True,
) -> PairwiseEstimator:
    """`kornia.geometry.RANSAC` with MSAC scores.

    Args:
        threshold: pixels.
        confidence: of having drawn a sample without an outlier, at which the search ends.
        batch_size: samples that are drawn together.
        rounds: batches at most.
        prosac: draw samples from the best matches first.

    Returns:
        The estimator.
    """

    def solve(pair: Pair) -> Solution:
        estimator = kornia.geometry.RANSAC(
            "fundamental", inl_th=threshold, batch_size=batch_size, max_iter=rounds, confidence=confidence,
            prosac_sampling=prosac, seed=pair.seed,
        )  # fmt: skip
        x0, x1, weights = (torch.from_numpy(a).to(torch.float32) for a in (pair.x0, pair.x1, pair.likelihood))
        F, mask = estimator(x0, x1, weights)
        return F.to(torch.float64).numpy(), mask.numpy().astype(np.bool_)

    return PairwiseEstimator("kornia", solve, best_first=prosac)
