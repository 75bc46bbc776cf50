"""The loop of a pruner's training: it goes on to the same weights, chooses the best ones, and skips no step."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch

pytest.importorskip("lightning", reason="training needs the extra `train`")

from fmtorch import presets
from fmtorch.pruning.networks import LC
from fmtorch.training.loop import (
    BEST,
    CHECKPOINTS,
    Optimisation,
    PrunerTraining,
    latest_checkpoint,
    train,
)
from fmtorch.training.objective import Objective
from fmtorch.training.validation import Use, Validation
from tests.processes import run_command
from tests.training.synthetic_matches import batches, labelled_pair

STEPS = 12
CPU = {"accelerator": "cpu", "devices": 1, "gradient_clip_val": 1.0}


def module() -> PrunerTraining:
    torch.manual_seed(0)
    network = LC(channels=8, blocks=2)
    uses = {"hard": Use(presets.build("estimator", "ransac", hypotheses=100), 0.5)}
    validation = Validation([labelled_pair(1000 + i) for i in range(3)], uses)
    return PrunerTraining(network, Objective(classification_steps=4), Optimisation(steps=STEPS), validation)


def trained(folder: Path, seen: list[int] | None = None) -> PrunerTraining:
    """The trained module; `seen` gets the steps that were made."""
    made = module()
    made.on_train_batch_start = lambda *_: None if seen is None else seen.append(made.global_step)
    steps, _ = train(made, batches, folder, CPU, every=5, checkpoint_every=3, patience=None, monitor="hard/AUC@0.05")
    assert steps == STEPS
    return made


def test_killed_and_started_again_it_ends_with_the_same_weights(tmp_path: Path) -> None:
    """Killed with SIGKILL in the middle of step 7, of 12; checkpoints are at 3 and 6, validation at 5 and 10."""
    whole = trained(tmp_path / "whole")
    script = f"""
import os, signal
from pathlib import Path
import torch
torch.set_num_threads({torch.get_num_threads()})
from tests.training import test_pruner_loop as t
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
    for name, value in whole.state_dict().items():
        assert torch.equal(value, parts.state_dict()[name]), name


class Ended(Exception):
    """What a kill would do."""


@pytest.mark.parametrize("last", [1, 2, 3])  # validations after 4, 8 and 12 steps
def test_ended_before_a_validation_it_is_made_again(tmp_path: Path, last: int) -> None:
    """Checkpoints are at the steps of validation; the best weights are those of an undisturbed training."""

    def run(folder: Path, ends_at: int | None) -> None:
        made, count = module(), 0

        def starts() -> None:
            nonlocal count
            count += 1
            if count == ends_at:
                raise Ended

        made.on_validation_start = starts  # type: ignore[method-assign]
        train(made, batches, folder, CPU, every=4, checkpoint_every=4, patience=None, monitor="log_loss")

    run(tmp_path / "whole", None)
    with pytest.raises(Ended):
        run(tmp_path / "parts", last)
    run(tmp_path / "parts", None)
    whole, parts = (torch.load(tmp_path / name / CHECKPOINTS / BEST, weights_only=True) for name in ("whole", "parts"))
    assert whole["global_step"] == parts["global_step"]
    for name, value in whole["state_dict"].items():
        assert torch.equal(value, parts["state_dict"][name]), name


def test_damaged_checkpoint_is_passed_over(tmp_path: Path) -> None:
    trained(tmp_path)
    (tmp_path / CHECKPOINTS / "step=99.ckpt").write_bytes(b"not a checkpoint")
    with pytest.warns(UserWarning, match="step=99"):
        path, step = latest_checkpoint(tmp_path)
    assert step == STEPS
    assert path is not None


def test_best_weights_are_kept(tmp_path: Path) -> None:
    trained(tmp_path)
    best = torch.load(tmp_path / CHECKPOINTS / BEST, weights_only=True)
    assert set(best["state_dict"]) == set(module().state_dict())
