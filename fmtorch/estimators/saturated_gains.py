"""A score that saturates where matches crowd, so that no single textured plane outvotes the rest of the image."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fmtorch.estimators.scores import GemanMcClure, check_threshold, geman_mcclure_gain
from fmtorch.geometry.arithmetic import fractional_bits, rounded_to, sqrt
from fmtorch.geometry.residuals import sampson_squared_of

GRID = 12  # cells along each side of each image
VECTORS = 128  # bytes that a processor computes on together, at most: two vectors


class SaturatedGains:
    """The sum over grid cells of ``sqrt(sum of P g(r))``, over both images; g is the gain of Geman & McClure.

    Saturates where matches crowd, so that a model which explains the whole image beats one that explains a single
    textured plane. The narrow peak of g tells exact models from those nearby, and its tail lets one scale serve scenes
    of different noise. The grid is that of the box around the matches of weight.
    threshold: the scale, at which a match counts half, Sampson distance, px. first_look: the plain sum of g, for a
    first look at few matches.
    """

    def __init__(self, threshold: float, prior_weighted: bool = True) -> None:
        check_threshold(threshold)
        self.threshold = float(threshold)
        self.prior_weighted = prior_weighted
        self.first_look = GemanMcClure(threshold, prior_weighted)

    def __call__(self, F: Tensor, points: Tensor, weight: Tensor, scale: Tensor) -> Tensor:
        """As `Score`."""
        (p, n), m = weight.shape, F.shape[2]
        whole = VECTORS // F.element_size()  # so many models at a time: the rest would be rounded differently
        F = torch.nn.functional.pad(F, (0, -m % whole))
        bits = fractional_bits(n, F.dtype)
        squared = (scale / self.threshold).square().to(F.dtype)[..., None]
        # (p, n, m): rows of models are added to a cell.
        r2 = sampson_squared_of(F[:, :, None], points[..., None]).mul_(squared)
        gain = rounded_to(geman_mcclure_gain(r2).mul_(weight[..., None]), bits).flatten(0, 1)
        first = GRID * GRID * torch.arange(p, device=F.device)[:, None]
        total = torch.zeros_like(F[0])
        for image in (points[:2], points[2:]):
            cell = (_cells(image, weight > 0) + first).flatten()
            sums = gain.new_zeros(p * GRID * GRID, F.shape[2]).index_add_(0, cell, gain)
            total += rounded_to(sqrt(sums), bits).view(p, GRID * GRID, -1).sum(1)
        return total[:, :m].nan_to_num_(0)


def _cells(points: Float[Tensor, "2 p n"], mask: Bool[Tensor, "p n"]) -> Int[Tensor, "p n"]:
    """The cell of each point in a grid over the bounding box of those in the mask."""
    low = torch.where(mask, points, torch.inf).amin(-1, keepdim=True)
    high = torch.where(mask, points, -torch.inf).amax(-1, keepdim=True)
    share = (points - low) / (high - low).clamp_min(torch.finfo(points.dtype).tiny)
    x: Tensor
    y: Tensor
    x, y = (share * GRID).nan_to_num(0).clamp(0, GRID - 1).to(torch.int64)
    return y * GRID + x
