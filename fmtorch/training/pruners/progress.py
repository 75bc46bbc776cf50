"""The progress bar of a training: steps, loss, and the best figure of validation so far."""

from __future__ import annotations

from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback
from rich.progress import Progress, TaskID

from fmtorch.core.terminal import progress_bars


class TrainingBar(Callback):
    """Shows the steps of the whole training, those of earlier attempts included.

    total: steps in all. monitor: the figure of validation that is shown.
    """

    def __init__(self, total: int, monitor: str) -> None:
        self.total, self.monitor = total, monitor
        self._progress: Progress | None = None
        self._bar: TaskID | None = None
        self._figure = ""

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Opens the bar, on rank zero."""
        if trainer.is_global_zero:
            self._progress = progress_bars()
            self._progress.start()
            self._bar = self._progress.add_task("training", total=self.total, completed=trainer.global_step)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Moves the bar."""
        if self._progress is not None and self._bar is not None:
            loss = outputs["loss"] if isinstance(outputs, dict) else outputs
            text = f"training: loss {float(loss):.3f}{self._figure}"
            self._progress.update(self._bar, completed=trainer.global_step, description=text)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Takes the latest figure into the bar's text."""
        value = trainer.callback_metrics.get(f"validation/{self.monitor}")
        if value is not None:
            self._figure = f", {self.monitor} {float(value):.3f}"

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Closes the bar, however the training ended."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
