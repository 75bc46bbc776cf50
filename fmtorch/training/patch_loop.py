"""The training loop of patch networks: every step is a function of the seed and its number, so a run can be resumed."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from fmtorch.features.networks import read_checkpoint
from fmtorch.jit import random
from fmtorch.jit.random import Stream
from fmtorch.training.patch_objectives import DRAWS, Objective
from fmtorch.training.patch_store import PatchStore


@dataclasses.dataclass(frozen=True)
class TrainingOptions:
    """How a patch network is trained; the learning rate falls linearly to zero over the run.

    batch: points a step, with two patches each. steps: the run's length, or minutes where that is given: wall time that
    this run has spent in all its parts. optimizer: adam or sgd (momentum 0.9, dampened as the authors of HardNet do).
    bf16: autocast to bfloat16. checkpoint_steps, log_steps: how often to save, to log.
    """

    batch: int = 512
    steps: int = 5000
    minutes: float | None = None
    optimizer: str = "adam"
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4
    seed: int = 0
    bf16: bool = True
    checkpoint_steps: int = 250
    log_steps: int = 50


class PatchTraining:
    """A network in training: `run` goes on to the end, or until a step; `checkpoint` keeps all that is needed."""

    def __init__(
        self, network: nn.Module, objective: Objective, store: PatchStore, options: TrainingOptions,
        description: dict[str, Any] | None = None, device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        if options.batch > len(store):
            raise ValueError(f"batch={options.batch} is more than the {len(store)} points there are")
        self.network, self.objective, self.store, self.options = network.to(device), objective, store, options
        self.description, self.device = description or {}, torch.device(device)
        self.optimizer = _optimizer(self.network, options)
        self.step, self.seconds = 0, 0.0
        self.losses: list[float] = []
        self._order: tuple[int, Tensor] = (-1, torch.zeros(0, dtype=torch.int64))

    def resume(self, path: Path | str) -> None:
        """Go on from a checkpoint of a run with the same options; ValueError names what differs."""
        content = read_checkpoint(path)
        mine, theirs = dataclasses.asdict(self.options), content.get("options", {})
        changed = [k for k, v in mine.items() if k not in ("steps", "minutes") and theirs.get(k) != v]
        if changed:
            raise ValueError(f"{path} was trained with other {', '.join(changed)}; start anew or take those options")
        self.network.load_state_dict(content["state_dict"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.step, self.seconds, self.losses = content["step"], content["seconds"], list(content["losses"])

    def run(
        self, until: int | None = None, checkpoint: Path | None = None, log: Callable[[str], None] | None = None
    ) -> None:
        """Train to the end, or to the step `until`. Raises FloatingPointError where the loss is no longer finite."""
        o = self.options
        last = time.perf_counter()
        self.network.train()
        while self.progress() < 1 and (until is None or self.step < until):
            for group in self.optimizer.param_groups:
                group["lr"] = o.learning_rate * (1 - self.progress())
            loss = self._one_step()
            if not torch.isfinite(loss):
                raise FloatingPointError(f"the loss is {float(loss)} at step {self.step}: lower the learning rate")
            self.losses.append(float(loss))
            self.step += 1
            now = time.perf_counter()
            self.seconds, last = self.seconds + now - last, now
            if log and self.step % o.log_steps == 0:
                recent = self.losses[-o.log_steps :]
                log(f"step {self.step} loss {sum(recent) / len(recent):.4f} seconds {self.seconds:.0f}")
            if checkpoint and self.step % o.checkpoint_steps == 0:
                self.save(checkpoint)
        if checkpoint:
            self.save(checkpoint)

    def progress(self) -> float:
        """The part of the run that is done, 0 to 1."""
        o = self.options
        return self.step / o.steps if o.minutes is None else self.seconds / (60 * o.minutes)

    def save(self, path: Path | str, **more: Any) -> None:
        """Write the checkpoint; a file that was there before is replaced when the new one is complete."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "state_dict": self.network.state_dict(), "optimizer": self.optimizer.state_dict(), "step": self.step,
            "seconds": self.seconds, "losses": self.losses, "options": dataclasses.asdict(self.options),
            "data": self.store.description, **self.description, **more,
        }  # fmt: skip
        unfinished = path.with_name(path.name + ".tmp")
        torch.save(content, unfinished)
        unfinished.replace(path)

    def _one_step(self) -> Tensor:
        o = self.options
        key = torch.tensor([self.step])
        draws = random.uniform(o.seed, key, Stream.TRAINING, 0, o.batch, DRAWS + 2)[0].float()
        torch.manual_seed(int(random.bits(o.seed, key, Stream.TRAINING, o.batch, 1, DRAWS + 2)[0, 0, 0]))  # dropout
        with torch.autocast(self.device.type, torch.bfloat16, enabled=o.bf16):
            loss = self._loss(draws)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        return loss.detach()

    def _loss(self, draws: Float[Tensor, "b k"]) -> Tensor:
        """The loss of this step's patches; `draws` are `DRAWS` random numbers of each point and two more."""
        pairs = self.store.views(self._points(), draws[:, DRAWS:])
        return self.objective.loss(self.network, pairs.to(self.device), draws.to(self.device))

    def _points(self) -> Int[Tensor, " b"]:
        """This step's points: each epoch is a random order of all."""
        per_epoch = len(self.store) // self.options.batch
        epoch, i = divmod(self.step, per_epoch)
        if self._order[0] != epoch:
            words = random.bits(self.options.seed + 1, torch.tensor([epoch]), Stream.TRAINING, 0, len(self.store), 1)
            self._order = epoch, words.flatten().argsort(stable=True)
        return self._order[1][i * self.options.batch : (i + 1) * self.options.batch]


def _optimizer(network: nn.Module, options: TrainingOptions) -> torch.optim.Optimizer:
    lr, decay = options.learning_rate, options.weight_decay
    if options.optimizer == "adam":
        return torch.optim.Adam(network.parameters(), lr=lr, weight_decay=decay)
    if options.optimizer == "sgd":
        return torch.optim.SGD(network.parameters(), lr=lr, momentum=0.9, dampening=0.9, weight_decay=decay)
    raise ValueError(f"optimizer={options.optimizer}; there are: adam, sgd")
