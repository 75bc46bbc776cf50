"""The loop of a pruner's training: it goes on to the same weights, chooses the best ones, and skips no step."""

import itertools
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

pytest.importorskip("lightning", reason="training needs the extra `train`")

from fmtorch import presets
from fmtorch.pruning import LC
from fmtorch.training import LabelledMatches, Objective, Use, Validation, collate, run
from fmtorch.training.run import Optimisation, PrunerTraining, latest_checkpoint
from tests.processes import run_command
from tests.training.conftest import labelled_pair

STEPS = 12
PAIRS = [labelled_pair(i) for i in range(24)]


class Steps:
    """The pairs of each step, four for each process."""

    def __init__(self, *where: int) -> None:
        self.start, self.rank, self.processes = where

    def __iter__(self) -> Iterator[list[int]]:
        firsts = (4 * (self.processes * step + self.rank) for step in itertools.count(self.start))
        return ([(first + i) % len(PAIRS) for i in range(4)] for first in firsts)


def batches(*where: int) -> DataLoader[LabelledMatches]:
    """Training batches of a process from a step on."""
    return DataLoader(PAIRS, batch_sampler=Steps(*where), collate_fn=collate)  # type: ignore[arg-type]


def module() -> PrunerTraining:
    torch.manual_seed(0)
    network = LC(channels=8, blocks=2)
    uses = {"hard": Use(presets.build("estimator", "ransac", hypotheses=100), 0.5)}
    validation = Validation([labelled_pair(1000 + i) for i in range(3)], uses)
    return PrunerTraining(network, Objective(classification_steps=4), Optimisation(steps=STEPS), validation)


def train(made: PrunerTraining, folder: Path, every: int, checkpoint_every: int, monitor: str) -> int:
    cpu = {"accelerator": "cpu", "devices": 1, "gradient_clip_val": 1.0}
    often = {"every": every, "checkpoint_every": checkpoint_every}
    return run.train(made, batches, folder, cpu, **often, patience=None, monitor=monitor)[0]


def trained(folder: Path, seen: list[int] | None = None) -> PrunerTraining:
    """The trained module; `seen` gets the steps that were made."""
    made = module()
    made.on_train_batch_start = lambda *_: None if seen is None else seen.append(made.global_step)
    assert train(made, folder, every=5, checkpoint_every=3, monitor="hard/AUC@0.05") == STEPS
    return made


def expect_equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    for name, value in a.items():
        assert torch.equal(value, b[name]), name


def test_killed_and_started_again_it_ends_with_the_same_weights(tmp_path: Path) -> None:
    """Killed with SIGKILL in the middle of step 7, of 12; checkpoints are at 3 and 6, validation at 5 and 10."""
    whole = trained(tmp_path / "whole")
    script = f"""
import os, signal
from pathlib import Path
import torch
torch.set_num_threads({torch.get_num_threads()})
from tests.training import test_loop as t
step = t.PrunerTraining.training_step
def dies(self, batch, index):
    if self.global_step == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, batch, index)
t.PrunerTraining.training_step = dies
t.trained(Path({str(tmp_path / "parts")!r}))
"""
    ended = run_command("-c", script, cwd=tmp_path)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    path, step = latest_checkpoint(tmp_path / "parts")
    assert path is not None
    assert step == 6
    seen: list[int] = []
    parts = trained(tmp_path / "parts", seen)
    assert seen == list(range(6, STEPS))
    expect_equal(whole.state_dict(), parts.state_dict())
    # The best weights are kept, and a damaged checkpoint is passed over.
    run.load_best(tmp_path / "parts", parts)
    (tmp_path / "parts" / run.CHECKPOINTS / "step=99.ckpt").write_bytes(b"not a checkpoint")
    with pytest.warns(UserWarning, match="step=99"):
        assert latest_checkpoint(tmp_path / "parts")[1] == STEPS


class Ended(Exception):
    """What a kill would do."""


def test_interrupted_it_says_what_is_kept(tmp_path: Path) -> None:
    stopped = module()

    def stop(*_: object) -> None:
        if stopped.global_step == 7:
            raise KeyboardInterrupt

    stopped.on_train_batch_start = stop
    with pytest.raises(KeyboardInterrupt, match=rf"step 6 of {STEPS} is kept in {tmp_path}"):
        train(stopped, tmp_path, every=5, checkpoint_every=3, monitor="hard/AUC@0.05")


def test_ended_before_a_validation_it_is_made_again(tmp_path: Path) -> None:
    """Checkpoints are at the steps of validation; the best weights are those of an undisturbed training."""

    def best(folder: Path, ends_at: int | None) -> tuple[int, dict[str, torch.Tensor]]:
        made, count = module(), itertools.count(1)

        def starts() -> None:
            if next(count) == ends_at:
                raise Ended

        made.on_validation_start = starts  # type: ignore[method-assign]
        train(made, folder, every=4, checkpoint_every=4, monitor="log_loss")
        return run.load_best(folder, made), made.state_dict()

    whole = best(tmp_path / "whole", None)
    for last in (1, 2, 3):  # validations after 4, 8 and 12 steps
        with pytest.raises(Ended):
            best(tmp_path / f"{last}", last)
        parts = best(tmp_path / f"{last}", None)
        assert whole[0] == parts[0]
        expect_equal(whole[1], parts[1])
