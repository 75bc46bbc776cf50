"""How good a pruner is: through real estimators on whole pairs, not by its loss alone."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Int8
from torch import Tensor, nn

from fmtorch import metrics
from fmtorch.core.stages import Estimator
from fmtorch.metrics.recall import FINE_THRESHOLD
from fmtorch.pruning.networks.learned import predict
from fmtorch.training.labelled import LabelledMatches
from fmtorch.training.objective import classification_loss

MAX_TEMPERATURE = 100.0  # and its inverse: bounds where the labels set none, as when they are perfectly separated
BISECTIONS = 50  # halvings of the interval of log temperature: 9.2 / 2^50


@dataclasses.dataclass(frozen=True, eq=False)
class Use:
    """One way of using P(inlier) before an estimator.

    threshold: matches with a smaller P are dropped and no prior is given; None: all are kept, with P as their prior.
    """

    estimator: Estimator
    threshold: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures by name, and the log-odds and labels of all labelled matches, from which a temperature is fitted."""

    figures: dict[str, float]
    logit: Tensor
    label: Tensor

    def temperature(self) -> float:
        """The temperature of least log loss."""
        return temperature(self.logit, self.label)


class Validation:
    """Evaluates a network on labelled matches of single pairs.

    Args:
        pairs: batches of one.
        uses: by name; each gives recall at NSGD 0.05 and 0.01 and AUC@0.05, the area under the recall curve to 0.05.
        families: of the pairs; where given, AUC@0.05 of each family is a figure of its own.
        seed: of sampling and of NSGD.
    """

    def __init__(
        self, pairs: Sequence[LabelledMatches], uses: Mapping[str, Use], families: Sequence[str] | None = None,
        seed: int = 0,
    ) -> None:  # fmt: skip
        if not pairs:
            raise ValueError("validation needs at least one pair; see validation.scenes and validation.roots")
        self.pairs, self.uses, self.seed = list(pairs), dict(uses), seed
        self.families = list(families) if families is not None else [""] * len(self.pairs)

    @torch.no_grad()
    def __call__(self, network: nn.Module) -> Evaluation:
        """The figures of a network in its present state, which is left as it was.
        Each pair is evaluated alone, in evaluation mode and on the CPU's one thread, as in use."""
        training, threads = network.training, torch.get_num_threads()
        device = next((p.device for p in network.parameters()), torch.device("cpu"))
        network.eval()
        torch.set_num_threads(1)
        try:
            predictions = (predict(network, pair.correspondences.to(device)) for pair in self.pairs)
            logits = [prediction.logit[-1].to("cpu", torch.float64) for prediction in predictions]
            nsgd = {name: self._nsgd(use, logits) for name, use in self.uses.items()}
        finally:
            torch.set_num_threads(threads)
            network.train(training)
        labelled = [pair.labelled for pair in self.pairs]
        logit = torch.cat([value[mask] for value, mask in zip(logits, labelled, strict=True)])
        label = torch.cat([pair.label[mask] for pair, mask in zip(self.pairs, labelled, strict=True)])
        loss = float(classification_loss(logit[None], label[None]))
        figures = {"log_loss": loss, **_classified(logit, label)}
        for name, values in nsgd.items():
            figures |= self._recalls(name, values)
        return Evaluation(figures, logit, label)

    def _nsgd(self, use: Use, logits: Sequence[Tensor]) -> Tensor:
        """NSGD of each pair; 1 where the estimate failed."""
        values = []
        for pair, logit in zip(self.pairs, logits, strict=True):
            c, p = pair.correspondences, torch.sigmoid(logit)
            if use.threshold is None:
                c = c.replace(prior=p.to(c.x0.dtype))
            else:
                c = c.keep(p >= use.threshold).compact()
            estimate = use.estimator(c, self.seed)
            assert c.size0 is not None
            assert c.size1 is not None
            error = metrics.nsgd(pair.F, estimate.F.to(torch.float64), c.size0, c.size1, seed=self.seed, key=c.keys)
            values.append(torch.where(estimate.ok, error, 1.0))
        return torch.cat(values)

    def _recalls(self, name: str, nsgd: Tensor) -> dict[str, float]:
        figures = {
            f"{name}/recall@0.05": float(metrics.recall(nsgd)),
            f"{name}/recall@0.01": float(metrics.recall(nsgd, FINE_THRESHOLD)),
            f"{name}/AUC@0.05": float(metrics.mean_recall(nsgd)),
        }
        for family in sorted(set(self.families) - {""}):
            mine = torch.tensor([f == family for f in self.families])
            figures[f"{name}/AUC@0.05/{family}"] = float(metrics.mean_recall(nsgd[mine]))
        return figures


def _classified(logit: Tensor, label: Tensor) -> dict[str, float]:
    """Precision and recall of the matches with P >= 0.5, and the expected calibration error."""
    kept, inlier = logit >= 0, label == 1
    right = float((kept & inlier).sum())
    return {
        "match_precision": right / max(float(kept.sum()), 1.0),
        "match_recall": right / max(float(inlier.sum()), 1.0),
        "calibration_error": reliability(torch.sigmoid(logit), label).error,
    }


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
