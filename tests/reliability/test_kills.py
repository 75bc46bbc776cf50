"""kill -9 when some results are already on disk: the same command goes on, and ends as if nothing had happened."""

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmtorch.runs import RunFolder
from tests.helpers import draw_set
from tests.processes import Command, Starter
from tests.reliability.conftest import Rows, evaluation, parts, results

KILLS = os.environ.get("FMTORCH_KILLS", "40,20,30,10")
EVAL_KILLS, MATCH_KILLS, TRAIN_KILLS, PROCESS_KILLS = map(int, KILLS.split(","))
TRAIN = [
    "optimisation.steps=8", "objective.classification_steps=2", "batch=2", "threads=1", "workers=1",
    "validation.scenes=1", "validation.pairs=2", "validation.every=4", "checkpoint_every=1",
    "validation.uses.hard.estimator=ransac", "validation.uses.prior.estimator=msac", "augmentation.crop=0",
    "features.max_features=300", "pruner.lc.network.channels=8", "pruner.lc.network.blocks=2",
]  # fmt: skip
QUICK = """
import fmtorch.training.export
fmtorch.training.export.export_onnx = lambda network, path, **_: path.touch()
"""
"""Run before a training: an export of the network, which takes seconds, changes nothing here."""


def delays(seed: int) -> Iterator[float]:
    """Seconds between what is waited for and the kill: none at all, within a pair's time, and beyond."""
    rng = np.random.default_rng(seed)
    while True:
        yield float(rng.choice([0.0, 0.0, rng.uniform(0, 0.02), rng.uniform(0, 0.2)]))


def bounded_and_whole(bounded: int, whole: int) -> list[Any]:
    """A small trial for every run of the tests, and the whole one on demand."""
    return [bounded, pytest.param(whole, marks=pytest.mark.reliability)]


def with_kills(
    start: Callable[[Path], Command], progress: Callable[[Path], int], folder: Path, kills: int, seed: int = 0
) -> list[Path]:
    """Start a command, killed once it has left more than before, and again, until that many kills; its folders."""
    killed, outputs, wait = 0, list[Path](), delays(seed)
    while killed < kills:
        assert len(outputs) < 10 * kills
        output = folder / f"out{len(outputs)}"
        outputs.append(output)
        while True:
            before = progress(output)
            command = start(output)
            if killed == kills or not command.kill_when(lambda: progress(output) > before, next(wait)):  # noqa: B023
                assert command.wait() == 0, command.said()
                break
            killed += 1
            assert progress(output) > before
    return outputs


@pytest.mark.parametrize("kills", bounded_and_whole(3, EVAL_KILLS))
def test_an_evaluation_goes_on(kills: int, starter: Starter, root: Path, truth: Rows, tmp_path: Path) -> None:
    outputs = with_kills(
        lambda output: starter.start(tmp_path, "eval", *evaluation(root, output)), parts, tmp_path, kills
    )
    assert all(results(output) == truth for output in outputs)


def test_features_that_a_killed_evaluation_kept_are_taken(starter, root, truth, tmp_path):
    """Of ten images; a damaged file is computed anew, and without the cache nothing is kept."""

    def files() -> list[Path]:
        return sorted(tmp_path.glob("cache/features/*/*.npz"))

    def evaluated(name: str, *extra: str) -> tuple[str, list[str]]:
        """What it says, and the numbers of images computed and taken."""
        done = starter.run(tmp_path, "eval", *evaluation(root, tmp_path / name, *extra))
        assert done.status == 0, done.said()
        return done.said(), re.findall(r"features of (\d+) images? computed(?:, of (\d+) taken)?", done.said())

    _, numbers = evaluated("off", "cache=off")
    assert (numbers, files()) == ([], [])
    killed = starter.start(tmp_path, "eval", *evaluation(root, tmp_path / "cold"))
    assert killed.kill_when(lambda: len(files()) >= 3), killed.said()
    had = len(files())
    assert 3 <= had < 10
    said, ((computed, taken),) = evaluated("cold")
    assert (int(computed), int(taken) > 0, "damaged" in said, "10 files" in said) == (10 - had, True, False, True)
    damaged = files()[0]
    damaged.write_bytes(damaged.read_bytes()[:1000])
    said, numbers = evaluated("warm")
    assert (numbers, f"{damaged.name} is damaged" in said) == ([("1", "9")], True)
    assert results(tmp_path / "off") == results(tmp_path / "cold") == results(tmp_path / "warm") == truth
    stored = (RunFolder.load(tmp_path / name).read().to_pylist() for name in ("cold", "warm"))
    before, after = ({row["pair"]: row["seconds_features"] for row in each} for each in stored)
    same = sum(before[pair] == after[pair] for pair in before)  # what computing took, not what reading did
    assert same >= len(before) - 2  # one image, of one or two pairs, was computed again
    assert not list(tmp_path.glob("cache/features/*/*.tmp"))


@pytest.mark.reliability
def test_with_processes_none_is_left_behind(starter: Starter, root: Path, truth: Rows, tmp_path: Path) -> None:
    extra = ("processes=true", "workers=2", "batch=1")
    outputs = with_kills(
        lambda output: starter.start(tmp_path, "eval", *evaluation(root, output, *extra)),
        parts, tmp_path, PROCESS_KILLS, seed=2,
    )  # fmt: skip
    assert all(results(output) == truth for output in outputs)
    deadline = time.monotonic() + 60
    while (left := running(str(tmp_path))) and time.monotonic() < deadline:
        time.sleep(0.5)
    assert left == []


def running(cwd: str) -> list[str]:
    """The command lines of the processes that work in a folder."""
    commands = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if os.readlink(process / "cwd") == cwd:
                commands.append((process / "cmdline").read_text().replace("\0", " "))
        except OSError:
            continue
    return commands


def match_result(folder: Path) -> dict[str, object]:
    """What the command for two photographs leaves, without what depends on the time."""
    result: dict[str, object] = json.loads((folder / "result.json").read_text())
    pictures = {path.name: path.read_bytes() for path in sorted(folder.glob("*.png"))}
    return {**{k: v for k, v in result.items() if k != "seconds"}, **pictures}


@pytest.mark.parametrize("kills", bounded_and_whole(1, MATCH_KILLS))
def test_two_photographs_are_matched_again(kills: int, starter: Starter, root: Path, tmp_path: Path) -> None:
    images = [f"image{i}={root}/scene0/Images/{i:08d}.png" for i in (0, 1)]

    def start(output: Path) -> Command:
        return starter.start(tmp_path, "match", "pipeline=sift_gms", *images, f"output={output}")

    def progress(output: Path) -> int:
        file = output / "result.json"
        return len(json.loads(file.read_text())) if file.exists() else 0

    assert start(tmp_path / "undisturbed").wait() == 0
    truth = match_result(tmp_path / "undisturbed")
    assert all(match_result(output) == truth for output in with_kills(start, progress, tmp_path, kills))


def trained(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in ("lc.safetensors", "validation.json")}


def newest(folder: Path) -> int:
    """The steps of the last checkpoint, -1 where there is none."""
    return max((int(path.stem.removeprefix("step=")) for path in folder.glob("checkpoints/step=*.ckpt")), default=-1)


@pytest.mark.parametrize("kills", bounded_and_whole(1, TRAIN_KILLS))
def test_a_training_goes_on(kills: int, starter: Starter, tmp_path: Path) -> None:
    pytest.importorskip("lightning", reason="training needs the extra `train`")
    root = draw_set(tmp_path / "Set", ["scene0", "scene1"], images=4)

    def start(output: Path) -> Command:
        words = ["dataset=fmbench", f"dataset.root={root}", *TRAIN, f"output={output}"]
        return starter.start(tmp_path, "train", *words, before=QUICK)

    undisturbed = start(tmp_path / "undisturbed")
    assert undisturbed.wait() == 0, undisturbed.said()
    truth = trained(tmp_path / "undisturbed")
    assert all(trained(output) == truth for output in with_kills(start, newest, tmp_path, kills))
