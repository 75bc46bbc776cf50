"""The figures of a whole evaluation as torchmetrics classes, which accumulate over batches and processes.

Needs the extra `metrics`: ``pip install 'fmtorch[metrics]'``."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int, Real
from torch import Tensor

from fmtorch.metrics import mean_recall, nsgd, pose_auc, pose_maa, pose_map, recall
from fmtorch.metrics.recall import BIN, MAA_MAXIMUM, THRESHOLD, THRESHOLDS

try:
    from torchmetrics import Metric  # type: ignore[import-not-found, unused-ignore]
except ImportError as error:
    raise ImportError("torchmetrics is not installed; pip install 'fmtorch[metrics]' brings it") from error


class _MeanOverPairs(Metric):  # type: ignore[misc, unused-ignore]
    """Sum and number of a figure over pairs. figure: the mean of a batch by the NSGD or pose errors of its pairs."""

    full_state_update = False
    is_differentiable, higher_is_better = False, True
    total: Tensor
    pairs: Tensor

    def __init__(self, figure: Callable[..., Tensor], **options: Any) -> None:
        super().__init__(**options)
        self.figure = figure
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("pairs", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, errors: Float[Tensor, " b"]) -> None:
        """Adds the NSGD of a batch, or its pose errors in degrees, `PoseError.worst`; NaN counts as a miss."""
        if len(errors):
            self.total = self.total + self.figure(errors).reshape(()) * len(errors)
            self.pairs = self.pairs + len(errors)

    def compute(self) -> Tensor:
        """The mean over all pairs so far, NaN when there are none."""
        return self.total / self.pairs


class NSGD(_MeanOverPairs):
    """Mean of `fmtorch.metrics.nsgd` over pairs."""

    is_differentiable, higher_is_better = True, False

    def __init__(self, *, samples: int = 1000, seed: int = 0, **options: Any) -> None:
        super().__init__(torch.mean, **options)
        self.samples, self.seed = samples, seed

    def update(  # type: ignore[override]
        self, F_gt: Float[Tensor, "b 3 3"], F_est: Float[Tensor, "b 3 3"], size0: Real[Tensor, "b 2"],
        size1: Real[Tensor, "b 2"], key: Int[Tensor, " b"] | None = None,
    ) -> None:  # fmt: skip
        """Adds a batch; arguments as `fmtorch.metrics.nsgd`."""
        super().update(nsgd(F_gt, F_est, size0, size1, samples=self.samples, seed=self.seed, key=key))


class Recall(_MeanOverPairs):
    """`fmtorch.metrics.recall` over all pairs, from their NSGD."""

    def __init__(self, *, threshold: float = THRESHOLD, **options: Any) -> None:
        super().__init__(functools.partial(recall, threshold=threshold), **options)


class MeanRecall(_MeanOverPairs):
    """AUC@0.05: `fmtorch.metrics.mean_recall` over all pairs, from their NSGD."""

    is_differentiable = True

    def __init__(self, *, maximum: float = THRESHOLD, **options: Any) -> None:
        super().__init__(functools.partial(mean_recall, maximum=maximum), **options)


class PoseMAA(_MeanOverPairs):
    """mAA(10): `fmtorch.metrics.pose_maa` over all pairs, from their pose errors in degrees."""

    def __init__(self, *, maximum: int = MAA_MAXIMUM, **options: Any) -> None:
        super().__init__(functools.partial(pose_maa, maximum=maximum), **options)


class PoseMAP(_MeanOverPairs):
    """Binned mAP: `fmtorch.metrics.pose_map` at one threshold over all pairs, from their pose errors in degrees."""

    def __init__(self, *, threshold: float | int = THRESHOLDS[1], bin: float | int = BIN, **options: Any) -> None:
        super().__init__(functools.partial(pose_map, thresholds=(threshold,), bin=bin), **options)


class PoseAUC(Metric):  # type: ignore[misc, unused-ignore]
    """`fmtorch.metrics.pose_auc` over all pairs, (t,), from their pose errors in degrees, all of which are kept."""

    is_differentiable, higher_is_better, full_state_update = True, True, False
    errors: list[Tensor]

    def __init__(self, *, thresholds: Sequence[float | int] = THRESHOLDS, **options: Any) -> None:
        super().__init__(**options)
        self.thresholds = tuple(thresholds)
        self.add_state("errors", [], dist_reduce_fx="cat")

    def update(self, errors: Float[Tensor, " b"]) -> None:
        """Adds the pose errors of a batch, `PoseError.worst`; NaN counts as a miss."""
        self.errors.append(errors)

    def compute(self) -> Tensor:
        """The area up to each threshold over all pairs so far, NaN when there are none."""
        errors = [self.errors] if isinstance(self.errors, Tensor) else self.errors  # one tensor after a reduction
        joined = torch.cat(errors) if errors else torch.zeros(0)
        return pose_auc(joined, self.thresholds) if len(joined) else joined.new_full((len(self.thresholds),), torch.nan)
