"""The Lightning module of a pruner's training: one step, validation through estimators, and what is logged."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from fmtorch.pipeline.labelled import LabelledMatches
from fmtorch.pruning.networks.learned import predict
from fmtorch.training.pruners.objective import Objective
from fmtorch.training.pruners.validation import Evaluation, Validation


@dataclasses.dataclass(frozen=True)
class Optimisation:
    """Adam (Kingma & Ba, ICLR 2015) at a constant rate that falls linearly to zero over the last part of the steps.

    Attributes:
        learning_rate: 1e-3 in Yi et al. 2018's code; the 1e-4 of one later paper trains far more slowly.
        weight_decay: L2 penalty of the parameters.
        steps: in all. decay: share of them, at the end, over which the rate falls.
    """

    learning_rate: float = 1e-3
    weight_decay: float = 0.0
    steps: int = 2500
    decay: float = 0.5

    def __post_init__(self) -> None:
        if not self.learning_rate > 0 or self.weight_decay < 0 or self.steps < 1 or not 0 <= self.decay <= 1:
            raise ValueError(
                f"optimisation={dataclasses.asdict(self)}: learning_rate and steps must be positive, weight_decay "
                "not negative, decay between 0 and 1"
            )

    def factor(self, step: int) -> float:
        """What the learning rate is multiplied by at a step."""
        left = (self.steps - step) / max(self.decay * self.steps, 1)
        return min(1.0, max(left, 0.0))


class PrunerTraining(lightning.LightningModule):
    """Trains a network that tells P(inlier); see `fmtorch.training.pruners` for the parts."""

    def __init__(
        self, network: nn.Module, objective: Objective, optimisation: Optimisation, validation: Validation
    ) -> None:
        super().__init__()
        self.network, self.objective, self.optimisation = network, objective, optimisation
        self.validation = validation
        self.evaluation: Evaluation | None = None
        self._seconds, self._started = 0.0, time.perf_counter()

    @property
    def seconds(self) -> float:
        """Spent on the training so far, in this and earlier attempts."""
        return self._seconds + time.perf_counter() - self._started

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keeps the seconds."""
        checkpoint["seconds"] = self.seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Goes on counting seconds."""
        self._seconds, self._started = float(checkpoint.get("seconds", 0.0)), time.perf_counter()

    def training_step(self, batch: LabelledMatches, index: int) -> Tensor:
        """The loss of a batch. Raises FloatingPointError where it is not finite: no step is skipped in silence."""
        prediction = predict(self.network, batch.correspondences)
        terms = self.objective(prediction, batch, self.global_step)
        if not bool(torch.isfinite(terms["loss"])):
            values = {name: float(value) for name, value in terms.items()}
            raise FloatingPointError(f"the loss of step {self.global_step} is not finite: {values}")
        self.log_dict({f"train/{name}": value.detach() for name, value in terms.items()}, batch_size=len(batch))
        return terms["loss"]

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Refuses gradients that are not finite."""
        norms = [p.grad.norm() for p in self.network.parameters() if p.grad is not None]
        total = torch.stack(norms).norm() if norms else torch.zeros(())
        if not bool(torch.isfinite(total)) and not self._scales_gradients():
            raise FloatingPointError(f"the gradient of step {self.global_step} is not finite")
        self.log("train/gradient_norm", total)

    def _scales_gradients(self) -> bool:
        """Whether mixed precision scales the loss: its scaler then skips a step that overflowed, as it is meant to."""
        return getattr(self.trainer.precision_plugin, "scaler", None) is not None

    def validation_step(self, batch: Any, index: int) -> None:
        """All of validation, in one step; on rank zero's pairs, the same on every rank."""
        self.evaluation = self.validation(self.network)
        self.log_dict({f"validation/{k}": v for k, v in self.evaluation.figures.items()}, batch_size=1, sync_dist=True)

    def configure_optimizers(self) -> Any:
        """Adam and its schedule."""
        o = self.optimisation
        adam = torch.optim.Adam(self.network.parameters(), lr=o.learning_rate, weight_decay=o.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: o.factor(step))
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
