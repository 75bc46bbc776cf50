"""`fmtorch train`, as a user runs it: from another directory, with a network of one's own."""

import gc
import itertools
import json
import re
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
import torch
from torch.utils.data import DataLoader

from fmtorch import presets
from fmtorch.data import DataError
from fmtorch.pruning import LC
from fmtorch.training import LabelledMatches, Objective, Use, Validation, collate
from fmtorch.training import run as loop
from fmtorch.training.run import Optimisation, PrunerTraining, latest_checkpoint, run
from tests.conftest import own_cache
from tests.helpers import compose, draw, draw_set, write_file
from tests.io import writers
from tests.processes import SOURCE, run_command
from tests.training.conftest import labelled_pair

pytest.importorskip("lightning", reason="training needs the extra `train`")


SHORT = [
    "optimisation.steps=6", "objective.classification_steps=2", "batch=2", "threads=1", "workers=1", "cache=off",
    "validation.scenes=1", "validation.pairs=2", "validation.every=3", "checkpoint_every=2",
    "validation.uses.hard.estimator=ransac", "validation.uses.prior.estimator=msac", "augmentation.crop=0",
    "features.max_features=300",
]  # fmt: skip
SMALL_LC = ["pruner.lc.network.channels=8", "pruner.lc.network.blocks=2", "output=out"]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return draw_set(tmp_path / "Set", "ab", pairs=[(0, 1), (0, 2), (1, 2)])


def test_a_network_of_ones_own_is_trained_and_used(root: Path, tmp_path: Path) -> None:
    """The files and commands of the docs, in an empty directory, on a small data set."""
    here = tmp_path / "here"
    page = (SOURCE / "docs" / "guides" / "training.md").read_text()
    section = re.split(r"^## ", page.partition("## A network of your own\n")[2], flags=re.MULTILINE)[0]
    module, preset, commands = re.findall(r"```\w+\n(.*?)```", section, flags=re.DOTALL)
    write_file(here / "mine.py", module)
    write_file(here / "my_conf" / "pruner" / "mine.yaml", preset)
    train, evaluate = (line.removeprefix("fmtorch ").split() for line in commands.strip().splitlines())
    data = ["dataset=fmbench", f"dataset.root={root}"]
    words = [w.strip("'") for w in train if not w.startswith("dataset")]
    trained = run_command(*words, *data, *SHORT, "output=out", cwd=here)
    assert trained.returncode == 0, trained.stderr
    assert (here / "out" / "mine.safetensors").is_file()
    assert "| trained on | 3 pairs of 1 scenes of fmbench |" in (here / "out" / "mine.md").read_text()
    figures = json.loads((here / "out" / "validation.json").read_text())
    assert 0 <= figures["prior/AUC@0.05"] <= 1
    used = [w.strip("'") for w in evaluate if not w.startswith(("dataset", "pruner.mine.file"))]
    used += ["pruner.mine.file=out/mine.safetensors", "output=run", "features.max_features=300"]
    evaluated = run_command(*used, *data, cwd=here)
    assert evaluated.returncode == 0, evaluated.stderr
    assert "mine" in (here / "run" / "run.json").read_text()


def test_two_processes_train_one_network(root: Path, tmp_path: Path) -> None:
    """With gloo and mixed precision, on the CPU: each has batches of its own, and gradients are averaged."""
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.precision=bf16-mixed", "limit=2"]
    ended = run_command("train", "dataset=fmbench", f"dataset.root={root}", *SHORT, *SMALL_LC, *two, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    checkpoint = torch.load(tmp_path / "out" / "checkpoints" / "step=6.ckpt", weights_only=True)
    assert checkpoint["global_step"] == 6
    assert all(bool(torch.isfinite(value).all()) for value in checkpoint["state_dict"].values())
    assert ended.stdout.count("pairs to train on: 2, to validate on: 2 (validation.pairs=2 of each family ") == 1
    assert "so few pairs (limit=2 of each family) show that it runs" in ended.stdout
    assert (tmp_path / "out" / "lc.safetensors").is_file()
    assert (tmp_path / "out" / "lc.onnx").stat().st_size > 1000


def trained(monkeypatch: pytest.MonkeyPatch, folder: Path, *overrides: str) -> Path:
    """The command without a process of its own, and without the export of the network, which takes seconds."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr("fmtorch.training.export.export_onnx", lambda network, path, **_: path.touch())
    monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(folder)))
    return run(compose("train", overrides), "lc")


def trained_twice(monkeypatch: pytest.MonkeyPatch, folder: Path, *overrides: str) -> Path:
    """The same, and once more, which goes on where the first one ended: with the same weights."""
    output = trained(monkeypatch, folder, *overrides)
    weights = (output / "lc.safetensors").read_bytes()
    trained(monkeypatch, folder, *overrides)
    assert (output / "lc.safetensors").read_bytes() == weights
    return output


def test_photographs_join_the_training(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two photographs seen as planes beside the pairs of a data set; the same command finds its views and matches."""
    for name in ("one", "two"):
        draw(tmp_path / "photographs" / name / "a.png", seed=len(name))
    planes = [f"planes.photographs={tmp_path / 'photographs'}", "planes.views=3", "planes.tilt=30"]
    options = ["dataset=fmbench", f"dataset.root={root}", *SHORT, *SMALL_LC, *planes]
    card = (trained_twice(monkeypatch, tmp_path, *options) / "lc.md").read_text()
    assert re.search(r"3 pairs of 1 scenes of fmbench and [1-6] pairs of [12] photographs seen as planes", card)
    for change, what in (("planes.seed=1", "matches"), ("seed=1", "seed")):
        with pytest.raises(ValueError, match=rf"holds checkpoints of other settings; what differs .*: {what}: "):
            trained(monkeypatch, tmp_path, *options, change)


def test_one_scene_alone_is_validated_on_its_last_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of eight images the last two make one pair, the first six fifteen; the others join both sides."""
    root = draw_set(tmp_path / "Set", "a", images=8, pairs=list(itertools.combinations(range(8), 2)))
    folder = trained(monkeypatch, tmp_path, "dataset=fmbench", f"dataset.root={root}", *SHORT, *SMALL_LC)
    card = (folder / "lc.md").read_text()
    assert "| trained on | 15 pairs of 1 scenes of fmbench |" in card
    assert "| validated on | 1 pairs of Set (" in card


def test_oanets_files_are_trained_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two files, of which the last is for validation, and a further one; the same command goes on."""
    root = writers.write_oanet(tmp_path / "oanet", outliers=20)
    shutil.copy(next(root.glob("*")), root / "b.hdf5")
    options = ["dataset=h5", "dataset.layout=oanet", f"dataset.root={root}", "labels=geodesic", *SHORT, "output=out",
               "pruner=lc_e", "pruner.lc_e.network.channels=8", "pruner.lc_e.network.blocks=2", "loaders=1",
               "objective.coordinates=K", f"validation.roots=[{root / 'b.hdf5'}]"]  # fmt: skip
    card = (trained_twice(monkeypatch, tmp_path, *options) / "lc.md").read_text()
    assert "| trained on | 3 pairs of 1 scenes of h5 |" in card
    gc.collect()  # Lightning's circles hold the open file
    with h5py.File(root / "b.hdf5", "a") as file:
        del file["ratios"]
    with pytest.raises(DataError, match=r"b.hdf5: 'ratios' is missing; without them give augmentation.ratio=null"):
        trained(monkeypatch, tmp_path, *options)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("planes.views=1", "planes.views=1; it must be a whole number of at least 2"),
        ("planes.views=many", "planes.views=many; it must be a whole number"),
        ("planes.photographs=nothing", "nothing is no folder of photographs"),
        ("pruner=ratio", "pruner=lc has nothing to train"), ("seed=0", "nowhere: no such folder"),
        ("batch=0", "batch=0; it must be a whole number of at least 1"),
        ("limit=-3", "limit=-3; it must be a whole number of at least 1"),
        ("optimisation.steps=0", "optimisation.steps=0; it must be a whole number of at least 1"),
        ("objective.coordinates=pixels", "it must be one of: size, K"),
        ("validation.monitor=foo", "validation.monitor=foo; it must be one of: log_loss, match_precision"),
    ],
)  # fmt: skip
def test_mistakes_are_reported_before_anything_is_written(option, message, tmp_path, monkeypatch):
    with pytest.raises((ValueError, FileNotFoundError), match=re.escape(message)):
        trained(monkeypatch, tmp_path, option, "dataset=fmbench", "dataset.root=nowhere")
    assert [path.name for path in tmp_path.rglob("*")] == ["cache", "kernels"]  # put there by `own_cache`


STEPS = 12
PAIRS = [labelled_pair(i) for i in range(24)]


class Steps:
    def __init__(self, *where: int) -> None:
        self.start, self.rank, self.processes = where

    def __iter__(self) -> Iterator[list[int]]:
        firsts = (4 * (self.processes * step + self.rank) for step in itertools.count(self.start))
        return ([(first + i) % len(PAIRS) for i in range(4)] for first in firsts)


def batches(*where: int) -> DataLoader[LabelledMatches]:
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
    return loop.train(made, batches, folder, cpu, **often, patience=None, monitor=monitor)[0]


def trained_by_hand(folder: Path, seen: list[int] | None = None) -> PrunerTraining:
    """The trained module; `seen` gets the steps that were made."""
    made = module()
    if seen is not None:
        made.on_train_batch_start = lambda *_: seen.append(made.global_step)
    assert train(made, folder, every=5, checkpoint_every=3, monitor="hard/AUC@0.05") == STEPS
    return made


def test_killed_and_started_again_it_ends_with_the_same_weights(tmp_path: Path) -> None:
    """Killed with SIGKILL in the middle of step 7, of 12; checkpoints are at 3 and 6, validation at 5 and 10."""
    whole = trained_by_hand(tmp_path / "whole")
    script = f"""
import os, signal
from pathlib import Path
import torch
torch.set_num_threads({torch.get_num_threads()})
from tests.training import test_train_command as t
step = t.PrunerTraining.training_step
def dies(self, batch, index):
    if self.global_step == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, batch, index)
t.PrunerTraining.training_step = dies
t.trained_by_hand(Path({str(tmp_path / "parts")!r}))
"""
    ended = run_command("-c", script, cwd=tmp_path)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    path, step = latest_checkpoint(tmp_path / "parts")
    assert path is not None
    assert step == 6
    seen: list[int] = []
    parts = trained_by_hand(tmp_path / "parts", seen)
    assert seen == list(range(6, STEPS))
    torch.testing.assert_close(whole.state_dict(), parts.state_dict(), rtol=0, atol=0)
    # The best weights are kept, and a damaged checkpoint is passed over.
    loop.load_best(tmp_path / "parts", parts)
    (tmp_path / "parts" / loop.CHECKPOINTS / "step=99.ckpt").write_bytes(b"not a checkpoint")
    with pytest.warns(UserWarning, match="step=99"):
        assert latest_checkpoint(tmp_path / "parts")[1] == STEPS


@pytest.mark.parametrize("step", [5, 7])
def test_interrupted_it_ends_the_step_and_says_what_is_kept(tmp_path: Path, step: int) -> None:
    """Validation is at 5 and 10: Ctrl-C after its step is met when it has its figure. A second one ends at once."""
    stopped, calls = module(), itertools.count(1)
    stopped.on_before_zero_grad = lambda _: next(calls) == step and signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match=rf"step {step} of {STEPS} is kept in {tmp_path}"):
        train(stopped, tmp_path, every=5, checkpoint_every=3, monitor="hard/AUC@0.05")
    assert {path.name for path in (tmp_path / loop.CHECKPOINTS).iterdir()} == {f"step={step}.ckpt", loop.BEST}
    stopped.on_before_zero_grad = lambda _: [signal.raise_signal(signal.SIGINT) for _ in range(2)]
    with pytest.raises(KeyboardInterrupt, match=rf"step {step} of"):
        train(stopped, tmp_path, every=5, checkpoint_every=3, monitor="hard/AUC@0.05")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_network_that_cannot_be_trained_is_named(tmp_path: Path) -> None:
    stopped, detached = module(), module()
    stopped.network.forward = lambda c: sys.exit(3)
    detached.network.forward = lambda c: c.mask.double()
    with pytest.raises(RuntimeError, match=r"LC ended the program: sys.exit\(3\)"):
        train(stopped, tmp_path, every=5, checkpoint_every=3, monitor="log_loss")
    with pytest.raises(ValueError, match="LC: its log-odds carry no gradient to its parameters"):
        train(detached, tmp_path, every=5, checkpoint_every=3, monitor="log_loss")


def test_a_short_training_is_validated_at_its_end(tmp_path: Path) -> None:
    trained = module()
    assert train(trained, tmp_path, every=10 * STEPS, checkpoint_every=3, monitor="log_loss") == STEPS
    assert loop.load_best(tmp_path, trained) == STEPS


def test_ended_before_a_validation_it_is_made_again(tmp_path: Path) -> None:
    """Checkpoints are at the steps of validation; the best weights are those of an undisturbed training."""

    def best(folder: Path, ends_at: int | None) -> tuple[int, dict[str, torch.Tensor]]:
        made, count = module(), itertools.count(1)

        def starts() -> None:
            if next(count) == ends_at:
                raise ZeroDivisionError  # what a kill would do

        made.on_validation_start = starts  # type: ignore[method-assign]
        train(made, folder, every=4, checkpoint_every=4, monitor="log_loss")
        return loop.load_best(folder, made), made.state_dict()

    whole = best(tmp_path / "whole", None)
    for last in (1, 3):  # validations after 4 and 12 steps
        with pytest.raises(ZeroDivisionError):
            best(tmp_path / f"{last}", last)
        parts = best(tmp_path / f"{last}", None)
        assert whole[0] == parts[0]
        torch.testing.assert_close(whole[1], parts[1], rtol=0, atol=0)
