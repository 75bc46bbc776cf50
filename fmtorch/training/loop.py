"""The training loop of pruners, by Lightning: steps, validation, checkpoints, and what is logged.

What is already done is taken up again, whatever ended the last attempt.
"""

import logging
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from rich.progress import Progress, TaskID
from torch import Tensor, nn
from torch.utils.data import DataLoader

from fmtorch.core.terminal import progress_bars
from fmtorch.data import ImagePair, read_image
from fmtorch.pipeline.pictures import draw_matches
from fmtorch.pruning.networks.learned import predict
from fmtorch.training.export import quiet
from fmtorch.training.labelled import LabelledMatches
from fmtorch.training.objective import Objective
from fmtorch.training.options import Optimisation as Optimisation
from fmtorch.training.validation import Evaluation, Validation

CHECKPOINTS, BEST, LOGS = "checkpoints", "best.ckpt", "logs"
SMALLER_IS_BETTER = ("log_loss", "calibration_error")  # figures of validation; of the others larger is
PICTURE_HEIGHT = 480  # px
QUIET = ("lightning.pytorch", "lightning.fabric")  # loggers, whose advice does not apply here


class PrunerTraining(lightning.LightningModule):
    """Trains a network that tells P(inlier)."""

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
        checkpoint["seconds"] = self.seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
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
        norms = [p.grad.norm() for p in self.network.parameters() if p.grad is not None]
        total = torch.stack(norms).norm() if norms else torch.zeros(())
        scaler = getattr(self.trainer.precision_plugin, "scaler", None)  # which skips a step that overflowed, as meant
        if not bool(torch.isfinite(total)) and scaler is None:
            raise FloatingPointError(f"the gradient of step {self.global_step} is not finite")
        self.log("train/gradient_norm", total)

    def validation_step(self, batch: Any, index: int) -> None:
        """All of validation, in one step; on rank zero's pairs, the same on every rank."""
        self.evaluation = self.validation(self.network)
        self.log_dict({f"validation/{k}": v for k, v in self.evaluation.figures.items()}, batch_size=1, sync_dist=True)

    def configure_optimizers(self) -> Any:
        o = self.optimisation
        adam = torch.optim.Adam(self.network.parameters(), lr=o.learning_rate, weight_decay=o.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: o.factor(step))
        return {"optimizer": adam, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def latest_checkpoint(folder: Path) -> tuple[Path | None, int]:
    """The checkpoint of most steps that can be read, and its steps; (None, 0) where there is none."""
    names = ((re.fullmatch(r"step=(\d+)", path.stem), path) for path in (folder / CHECKPOINTS).glob("step=*.ckpt"))
    for step, path in sorted(((int(match[1]), path) for match, path in names if match), reverse=True):
        try:
            torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch.load raises nearly anything for damaged bytes; an older file may do
            warnings.warn(f"{path} cannot be read and is passed over ({error})", stacklevel=2)
            continue
        return path, step
    return None, 0


def load_best(folder: Path, module: PrunerTraining) -> int:
    """Give a module the best weights that validation saw; returns their step. Raises FileNotFoundError without any."""
    best = torch.load(folder / CHECKPOINTS / BEST, map_location="cpu", weights_only=True)
    module.load_state_dict(best["state_dict"])
    return int(best["global_step"])


def train(
    module: PrunerTraining, batches: Callable[[int, int, int], DataLoader[Any]], folder: Path,
    trainer: Mapping[str, Any], *, every: int, checkpoint_every: int, patience: int | None, monitor: str,
    callbacks: tuple[Callback, ...] = (),
) -> tuple[int, float]:  # fmt: skip
    """Train in `folder`, going on from its last checkpoint; returns the steps and seconds made in all.
    batches: from (step, rank, processes) to the training batches from that step on, which must always be the same.
    folder: keeps checkpoints and TensorBoard's logs. trainer: further arguments of lightning.Trainer. every,
    checkpoint_every: steps between two validations, and two checkpoints. patience: validations without a better figure
    after which training ends; None: never. monitor: the figure of validation that chooses the best weights."""
    path, step = latest_checkpoint(folder)
    figure, mode = f"validation/{monitor}", "min" if monitor in SMALLER_IS_BETTER else "max"
    total = module.optimisation.steps
    kept = _ResumableCheckpoint(
        folder / CHECKPOINTS, "{step}", save_top_k=1, monitor="step", mode="max", every_n_train_steps=checkpoint_every,
        enable_version_counter=False, save_on_train_epoch_end=False, validated_every=every,
    )  # fmt: skip
    best = ModelCheckpoint(
        folder / CHECKPOINTS, "best", monitor=figure, mode=mode, enable_version_counter=False, save_weights_only=True
    )
    stop = [] if patience is None else [EarlyStopping(figure, mode=mode, patience=patience, strict=True)]
    with quiet(QUIET, logging.WARNING), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(does not have many workers|exists and is not empty).*")
        warnings.filterwarnings("ignore", category=FutureWarning, module="lightning.*")
        lightning_trainer = lightning.Trainer(
            max_steps=total, max_epochs=1, val_check_interval=every, check_val_every_n_epoch=None,
            num_sanity_val_steps=0, log_every_n_steps=min(10, every), default_root_dir=folder,
            logger=TensorBoardLogger(folder, name=LOGS, version=""), use_distributed_sampler=False,
            callbacks=[best, kept, *stop, _TrainingBar(total, monitor), *callbacks],
            enable_progress_bar=False, enable_model_summary=False, deterministic=True, **trainer,
        )  # fmt: skip
        if step < total:
            own = batches(step, lightning_trainer.global_rank, lightning_trainer.world_size)
            once: Any = [0]  # one item, for the one step of validation, which has its own pairs
            validation: DataLoader[Any] = DataLoader(once, batch_size=None)
            try:
                lightning_trainer.fit(module, own, validation, ckpt_path=path, weights_only=True)
            except SystemExit:  # which Lightning makes of Ctrl-C
                reached = latest_checkpoint(folder)[1]
                raise KeyboardInterrupt(f"step {reached} of {total} is kept in {folder}") from None
            step = lightning_trainer.global_step
    return step, module.seconds


class _ResumableCheckpoint(ModelCheckpoint):
    """Checkpoints at every so many steps: at a step of validation when that is done, its best figure included.
    Lightning saves before it validates, and a training that goes on from there would lack that validation."""

    def __init__(self, *args: Any, validated_every: int, **options: Any) -> None:
        super().__init__(*args, **options)
        self.validated_every = validated_every

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        if trainer.global_step % self.validated_every:
            super().on_train_batch_end(trainer, trainer.lightning_module, {}, None, 0)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Save after a validation; that of the best weights comes before in the list of callbacks."""
        super().on_train_batch_end(trainer, pl_module, {}, None, 0)
        super().on_validation_end(trainer, pl_module)  # what the last batch puts off


class _TrainingBar(Callback):
    """The progress bar of a training, earlier attempts included: steps, loss, and the best figure of validation so far.
    total: steps in all. monitor: the figure of validation that is shown."""

    def __init__(self, total: int, monitor: str) -> None:
        self.total, self.monitor = total, monitor
        self._progress: Progress | None = None
        self._bar: TaskID | None = None
        self._figure = ""

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if trainer.is_global_zero:
            self._progress = progress_bars()
            self._progress.start()
            self._bar = self._progress.add_task("training", total=self.total, completed=trainer.global_step)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._progress is not None and self._bar is not None:
            loss = outputs["loss"] if isinstance(outputs, dict) else outputs
            text = f"training: loss {float(loss):.3f}{self._figure}"
            self._progress.update(self._bar, completed=trainer.global_step, description=text)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        value = trainer.callback_metrics.get(f"validation/{self.monitor}")
        if value is not None:
            self._figure = f", {self.monitor} {float(value):.3f}"

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None


class ValidationPictures(Callback):
    """Draws some validation pairs: matches with P(inlier) >= 0.5 green, the others thin and red.
    pairs: the pairs and their matches, batches of one."""

    def __init__(self, pairs: Sequence[tuple[ImagePair, LabelledMatches]]) -> None:
        self.pairs = list(pairs)

    @torch.no_grad()
    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        assert isinstance(pl_module, PrunerTraining)
        if not isinstance(trainer.logger, TensorBoardLogger) or not trainer.is_global_zero:
            return
        board = trainer.logger.experiment
        for pair, matches in self.pairs:
            picture = classified(pair, matches, pl_module.network)
            board.add_image(pair.identity, picture, trainer.global_step, dataformats="HWC")


@torch.no_grad()
def classified(pair: ImagePair, matches: LabelledMatches, network: torch.nn.Module) -> NDArray[np.uint8]:
    """The two images of a pair with its matches as a network classifies them; RGB (H, W, 3)."""
    device = next((p.device for p in network.parameters()), torch.device("cpu"))
    training = network.training
    network.eval()
    c = matches.correspondences
    kept = (predict(network, c.to(device)).logit[-1, 0] >= 0).cpu().numpy()
    network.train(training)
    inside = c.mask[0].numpy()
    x0, x1 = (x[0].double().numpy()[inside] for x in (c.x0, c.x1))
    image0, image1 = read_image(pair.image0), read_image(pair.image1)
    names = ("P(inlier) >= 0.5", "below")
    return draw_matches(image0, image1, x0, x1, kept[inside], height=PICTURE_HEIGHT, names=names)
