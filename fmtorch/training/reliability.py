"""Whether predicted probabilities hold: a reliability table, and the temperature that mends overconfident logits."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Int8
from torch import Tensor

MAX_TEMPERATURE = 100.0  # and its inverse: bounds where the labels set none, as when they are perfectly separated
BISECTIONS = 50  # halvings of the interval of log temperature: 9.2 / 2^50


class Reliability(NamedTuple):
    """Predicted against observed shares of inliers, over bins of equal width of the predicted probability.

    edges: of the bins. matches: how many fell in each. predicted: their mean probability. observed: their share of
    inliers; both NaN in an empty bin. error: the expected calibration error, the mean over matches of
    |predicted - observed| of their bin (Naeini et al., AAAI 2015); NaN without matches.
    """

    edges: Float[Tensor, " bins_and_1"]
    matches: Int[Tensor, " bins"]
    predicted: Float[Tensor, " bins"]
    observed: Float[Tensor, " bins"]
    error: float


def temperature(logit: Float[Tensor, "*matches"], label: Int8[Tensor, "*matches"]) -> float:
    """The T that minimises the mean cross-entropy of the logits divided by T (Guo et al., ICML 2017, section 4.2).

    The loss is convex in 1 / T; the root of its derivative is found by bisection. Nothing else is fitted, so the order
    of the matches stays as it is, and so does the decision at probability one half.

    Args:
        logit: predicted log-odds of validation matches, of any shape.
        label: 1 inlier, 0 outlier, -1 ignored.

    Returns:
        T, between 1 / MAX_TEMPERATURE and MAX_TEMPERATURE: at a bound where the best T lies beyond, as when the logits
        separate the classes. 1 where there is no labelled match or every logit is zero.
    """
    labelled = label >= 0
    z = logit.detach()[labelled].to(torch.float64)
    target = (label[labelled] > 0).to(torch.float64)
    if not bool((z != 0).any()):
        return 1.0

    def slope(log_t: float) -> float:
        """Of the loss along 1 / T: rises with 1 / T."""
        return float(((torch.sigmoid(z * math.exp(-log_t)) - target) * z).sum())

    low, high = -math.log(MAX_TEMPERATURE), math.log(MAX_TEMPERATURE)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if slope(middle) > 0:  # too sure: a higher temperature is better
            low = middle
        else:
            high = middle
    return math.exp((low + high) / 2)


def reliability(
    probability: Float[Tensor, "*matches"], label: Int8[Tensor, "*matches"], *, bins: int = 10
) -> Reliability:
    """Predicted probabilities against observed shares of inliers.

    Args:
        probability: that a match is an inlier, of any shape.
        label: 1 inlier, 0 outlier, -1 ignored.
        bins: of equal width from 0 to 1; a probability of 1 falls in the last.

    Returns:
        The table and the expected calibration error, float64.

    Raises:
        ValueError: bins is less than 1.
    """
    if bins < 1:
        raise ValueError(f"bins is {bins}; it must be at least 1")
    labelled = label >= 0
    p = probability.detach()[labelled].to(torch.float64)
    target = (label[labelled] > 0).to(torch.float64)
    index = (p * bins).long().clamp(0, bins - 1)
    count = torch.bincount(index, minlength=bins)
    sums = [torch.bincount(index, weights=x, minlength=bins) for x in (p, target)]
    predicted, observed = (s / count for s in sums)
    error = float((sums[0] - sums[1]).abs().sum() / count.sum())
    edges = torch.linspace(0, 1, bins + 1, dtype=torch.float64, device=p.device)
    return Reliability(edges, count, predicted, observed, error)
