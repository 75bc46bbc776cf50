"""Recall over a set of pairs at a limit on their NSGD, its curve, and its mean up to a limit."""

import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch.core.checks import checked

THRESHOLD = 0.05  # NSGD below which an estimate counts as recalled (Bian et al., BMVC 2019)
FINE_THRESHOLD = 0.01  # NSGD below which it counts as accurate
CURVE = (0.0, 0.2, 20)  # first and last threshold and their number, as in the paper's curves


@checked
def recall(nsgd: Float[Tensor, "*batch pairs"], threshold: float = THRESHOLD) -> Float[Tensor, "*batch"]:
    """Share of all pairs with NSGD strictly below the threshold.

    Args:
        nsgd: of each pair; NaN, a failure, counts as a miss.
        threshold: in image diagonals, as NSGD.

    Returns:
        The share, NaN where there are no pairs.

    Example:
        >>> import torch
        >>> from fmtorch.metrics import mean_recall, recall
        >>> nsgd = torch.tensor([0.0, 0.01, 0.2, torch.nan])
        >>> recall(nsgd).item(), round(mean_recall(nsgd).item(), 3)
        (0.5, 0.45)
    """
    return (nsgd < threshold).to(nsgd.dtype).mean(-1)


@checked
def recall_curve(
    nsgd: Float[Tensor, "*batch pairs"], thresholds: Float[Tensor, " t"] | None = None
) -> Float[Tensor, "*batch t"]:
    """`recall` at each of several thresholds.

    Args:
        nsgd: of each pair; NaN counts as a miss.
        thresholds: in image diagonals; when not given, the paper's: 20 from 0 to 0.2.

    Returns:
        The share of the pairs below each threshold.
    """
    if thresholds is None:
        first, last, count = CURVE
        thresholds = torch.linspace(first, last, count, dtype=nsgd.dtype, device=nsgd.device)
    return (nsgd[..., None, :] < thresholds[:, None]).to(nsgd.dtype).mean(-1)


@checked
def mean_recall(nsgd: Float[Tensor, "*batch pairs"], maximum: float = THRESHOLD) -> Float[Tensor, "*batch"]:
    """Mean of `recall` over thresholds from 0 to `maximum`, by default AUC@0.05: the area under its curve, exactly.

    A pair with NSGD e is recalled at the share max(0, 1 - e / maximum) of the thresholds, so this is the mean of that
    over pairs, and differentiable in e.

    Args:
        nsgd: of each pair; NaN counts as a miss.
        maximum: the last threshold, in image diagonals.

    Returns:
        The area over `maximum`, within [0, 1].

    Raises:
        ValueError: `maximum` is not positive.
    """
    if not maximum > 0:
        raise ValueError(f"maximum is {maximum}; it must be positive")
    missed = nsgd.isnan()
    share = (1 - torch.where(missed, maximum, nsgd) / maximum).clamp(0.0, 1.0)
    return share.mean(-1)
