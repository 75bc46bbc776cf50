"""The figures of a whole evaluation as torchmetrics classes, which accumulate over batches and processes.

Needs the extra `metrics`: ``pip install 'fmtorch[metrics]'``.
"""

from collections.abc import Sequence
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
    """Sum and number of a figure per pair."""

    full_state_update = False
    is_differentiable, higher_is_better = False, True
    total: Tensor
    pairs: Tensor

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("pairs", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def _add(self, mean: Tensor, pairs: int) -> None:
        if pairs:
            self.total = self.total + mean * pairs
            self.pairs = self.pairs + pairs

    def compute(self) -> Tensor:
        """The mean over all pairs so far, NaN when there are none."""
        return self.total / self.pairs


class NSGD(_MeanOverPairs):
    """Mean of `fmtorch.metrics.nsgd` over pairs."""

    is_differentiable, higher_is_better = True, False

    def __init__(self, *, samples: int = 1000, seed: int = 0, **options: Any) -> None:
        super().__init__(**options)
        self.samples, self.seed = samples, seed

    def update(
        self,
        F_gt: Float[Tensor, "b 3 3"],
        F_est: Float[Tensor, "b 3 3"],
        size0: Real[Tensor, "b 2"],
        size1: Real[Tensor, "b 2"],
        key: Int[Tensor, " b"] | None = None,
    ) -> None:
        """Adds a batch; arguments as `fmtorch.metrics.nsgd`."""
        value = nsgd(F_gt, F_est, size0, size1, samples=self.samples, seed=self.seed, key=key)
        self._add(value.mean(), len(value))


class Recall(_MeanOverPairs):
    """`fmtorch.metrics.recall` over all pairs, from their NSGD."""

    def __init__(self, *, threshold: float = THRESHOLD, **options: Any) -> None:
        super().__init__(**options)
        self.threshold = threshold

    def update(self, nsgd: Float[Tensor, " b"]) -> None:
        """Adds the NSGD of a batch; NaN counts as a miss."""
        self._add(recall(nsgd, self.threshold), len(nsgd))


class MeanRecall(_MeanOverPairs):
    """AUC@0.05: `fmtorch.metrics.mean_recall` over all pairs, from their NSGD."""

    is_differentiable = True

    def __init__(self, *, maximum: float = THRESHOLD, **options: Any) -> None:
        super().__init__(**options)
        self.maximum = maximum

    def update(self, nsgd: Float[Tensor, " b"]) -> None:
        """Adds the NSGD of a batch; NaN counts as a miss."""
        self._add(mean_recall(nsgd, self.maximum), len(nsgd))


class PoseMAA(_MeanOverPairs):
    """mAA(10): `fmtorch.metrics.pose_maa` over all pairs, from their pose errors in degrees."""

    def __init__(self, *, maximum: int = MAA_MAXIMUM, **options: Any) -> None:
        super().__init__(**options)
        self.maximum = maximum

    def update(self, errors: Float[Tensor, " b"]) -> None:
        """Adds the pose errors of a batch, `PoseError.worst`; NaN counts as a miss."""
        self._add(pose_maa(errors, self.maximum), len(errors))


class PoseMAP(_MeanOverPairs):
    """Binned mAP: `fmtorch.metrics.pose_map` at one threshold over all pairs, from their pose errors in degrees."""

    def __init__(self, *, threshold: float | int = THRESHOLDS[1], bin: float | int = BIN, **options: Any) -> None:
        super().__init__(**options)
        self.threshold, self.bin = threshold, bin

    def update(self, errors: Float[Tensor, " b"]) -> None:
        """Adds the pose errors of a batch, `PoseError.worst`; NaN counts as a miss."""
        self._add(pose_map(errors, (self.threshold,), self.bin)[0], len(errors))


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
