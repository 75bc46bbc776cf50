"""Local optimisation: good models made better from their inliers before one of them is chosen."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.core import random
from fmtorch.core.random import Stream
from fmtorch.estimators.pairs import NormalizedPairs
from fmtorch.estimators.sampling import with_replacement
from fmtorch.estimators.scores import CPU_TILE, GPU_TILE, Score, score_models
from fmtorch.estimators.spatial import gaussian_kernel, neighbor_graph, spatially_coherent_inliers
from fmtorch.geometry.eight_point import NormalEquations, fundamental_of
from fmtorch.geometry.residuals import sampson_squared

FIRST_DRAW = 1 << 32  # of the samples drawn here: beyond those of any search, so that they are others


@runtime_checkable
class LocalOptimization(Protocol):
    """Improves a small pool of models; none comes back with a lower score than it had."""

    def __call__(self, F: Float[Tensor, "9 p k"], pairs: NormalizedPairs) -> Float[Tensor, "9 p k"]:
        """The improved models, float64; without gradients."""
        ...


class GraphCut:
    """The local optimisation of Graph-Cut RANSAC (Barath & Matas, CVPR 2018, algorithm 2).

    Label the matches with spatial coherence, fit the 8-point algorithm to samples of the inliers and to all of them,
    take the fit of the highest score, and again while the score rises. The samples hold seven times as many matches as
    a minimal one, as in the paper, here drawn with replacement.
    threshold: epsilon of the labelling, Sampson distance, px. score: what is improved.
    """

    COHERENCE = 0.1  # lambda; as the radius and the size of samples in section 4 of the paper
    RADIUS_PX = 20.0  # px, of the ball of neighbours in (x0, y0, x1, y1)
    SAMPLE_SIZE = 49
    SAMPLES = 20  # in each iteration
    ITERATIONS = 2  # at most; with 3, 2 of two models: AUC@0.05 41.7, 40.8 on every other tuning pair, two seeds

    def __init__(self, threshold: float, score: Score) -> None:
        self.threshold, self.score = threshold, score

    def __call__(self, F: Float[Tensor, "9 p k"], pairs: NormalizedPairs) -> Float[Tensor, "9 p k"]:
        """As `LocalOptimization`; in tiles of pairs that bound the memory."""
        limit = GPU_TILE if F.is_cuda else CPU_TILE
        at_once = max(1, limit // (F.shape[2] * pairs.mask.shape[1]))
        with torch.no_grad():
            tiles = torch.split(torch.arange(F.shape[1], device=F.device), at_once)
            return torch.cat([self._improved(F[:, tile], pairs[tile]) for tile in tiles], 1)

    def _improved(self, F: Float[Tensor, "9 p k"], pairs: NormalizedPairs) -> Float[Tensor, "9 p k"]:
        graph = neighbor_graph(pairs, self.RADIUS_PX)
        scale = (pairs.pixels_per_unit / self.threshold).square()[:, None, None]
        score = score_models(self.score, F.to(torch.float32), pairs)
        rising = torch.ones_like(score, dtype=torch.bool)
        for i in range(self.ITERATIONS):
            kernel = gaussian_kernel(sampson_squared(F, pairs.points) * scale)
            labels = spatially_coherent_inliers(kernel, pairs.mask, graph, self.COHERENCE)
            fits, valid = self._fits(labels, pairs, i)
            fit_score = score_models(self.score, fits.flatten(2).to(torch.float32), pairs)
            best, which = first_maximum(fit_score.reshape(valid.shape).masked_fill(~valid, -torch.inf))
            rising = rising & (best > score)
            if not bool(rising.any()):
                break
            fit = fits.gather(3, which.expand(9, -1, -1, -1))[..., 0]
            F, score = torch.where(rising, fit, F), torch.where(rising, best, score)
        return F

    def _fits(
        self, labels: Bool[Tensor, "p k n"], pairs: NormalizedPairs, iteration: int
    ) -> tuple[Float[Tensor, "9 p k m"], Bool[Tensor, "p k m"]]:
        """Fits to all inliers of each model and to samples of them, and which are determined."""
        k = labels.shape[1]
        everything = pairs.points[:, :, None].expand(-1, -1, k, -1)
        whole = _normal_equations(everything[:, :, :, None], labels[:, :, None].to(torch.float64))
        first = FIRST_DRAW + iteration * self.SAMPLES
        bits = random.bits(pairs.seed, pairs.key, Stream.SAMPLING, first, self.SAMPLES, self.SAMPLE_SIZE)
        index = with_replacement(bits.flatten(1)[:, None].expand(-1, k, -1), labels.to(torch.int64))
        sample = everything.gather(3, index.expand(4, -1, -1, -1))
        some = _normal_equations(sample.reshape(*sample.shape[:3], self.SAMPLES, self.SAMPLE_SIZE))
        together = NormalEquations(*(torch.cat(values, 2) for values in zip(whole, some, strict=True)))
        F, valid = fundamental_of(together)
        return F.flatten(-2).movedim(-1, 0), valid


def first_maximum(x: Float[Tensor, "p k m"]) -> tuple[Float[Tensor, "p k"], Int[Tensor, "p k 1"]]:
    """The maximum over the last axis and the first place where it stands, on any device."""
    top, order = torch.sort(x, dim=-1, descending=True, stable=True)
    return top[..., 0], order[..., :1]


def _normal_equations(points: Float[Tensor, "4 *sets n"], weight: Tensor | None = None) -> NormalEquations:
    return NormalEquations.of(points[:2].movedim(0, -1), points[2:].movedim(0, -1), weight)
