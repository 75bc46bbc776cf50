"""kill -9 when some results are already on disk: the same command goes on, and ends as if nothing had happened."""

import json
import os
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import draw_set
from tests.processes import Starter
from tests.reliability.commands import delays, evaluation, parts, results
from tests.reliability.conftest import Rows

EVAL_KILLS, MATCH_KILLS, TRAIN_KILLS, PROCESS_KILLS = (
    int(number) for number in os.environ.get("FMTORCH_KILLS", "40,20,30,10").split(",")
)
TRAIN = [
    "optimisation.steps=8", "objective.classification_steps=2", "batch=2", "threads=1", "workers=1",
    "validation.scenes=1", "validation.pairs=2", "validation.every=4", "checkpoint_every=1",
    "validation.uses.hard.estimator=ransac", "validation.uses.prior.estimator=msac", "augmentation.crop=0",
    "features.max_features=300", "pruner.lc.network.channels=8", "pruner.lc.network.blocks=2",
]  # fmt: skip


Property = Callable[[str, object], None]


def bounded_and_whole(bounded: int, whole: int) -> list[Any]:
    """A small trial for every run of the tests, and the whole one on demand."""
    return [bounded, pytest.param(whole, marks=pytest.mark.reliability)]


def evaluate_with_kills(
    starter: Starter, root: Path, folder: Path, kills: int, seed: int, *extra: str
) -> tuple[int, list[Rows]]:
    """Evaluate, killed once more rows than before are on disk, and again, until that many kills; the runs' rows."""
    killed, finished, wait = 0, [], delays(seed)
    while killed < kills:
        run_dir = folder / f"run{len(finished)}"
        while True:
            before = parts(run_dir)
            command = starter.start(folder, "eval", *evaluation(root, run_dir, *extra))
            if killed < kills and command.kill_when(lambda: parts(run_dir) > before, next(wait)):  # noqa: B023
                killed += 1
                assert parts(run_dir) >= min(before + 1, 9)
                continue
            assert command.wait() == 0, command.said()
            break
        finished.append(results(run_dir))
    return killed, finished


@pytest.mark.parametrize("kills", bounded_and_whole(3, EVAL_KILLS))
def test_an_evaluation_goes_on(kills, starter, root, truth, tmp_path, record_property):
    killed, finished = evaluate_with_kills(starter, root, tmp_path, kills, 0)
    assert killed == kills
    assert all(rows == truth for rows in finished)
    record_property("kills of eval", killed)


@pytest.mark.reliability
def test_with_processes_none_is_left_behind(starter, root, truth, tmp_path, record_property):
    extra = ("processes=true", "workers=2", "batch=1")
    killed, finished = evaluate_with_kills(starter, root, tmp_path, PROCESS_KILLS, 2, *extra)
    assert all(rows == truth for rows in finished)
    deadline = time.monotonic() + 60
    while (left := running(str(tmp_path))) and time.monotonic() < deadline:
        time.sleep(0.5)
    assert left == []
    record_property("kills of eval with processes", killed)


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


def match_with_kills(starter: Starter, root: Path, folder: Path, kills: int, seed: int) -> int:
    """Match two photographs, killed once the result is on disk, then to the end; checks that nothing is different."""
    images = [f"image{i}={root}/scene0/Images/{i:08d}.png" for i in (0, 1)]
    arguments = ["pipeline=sift_gms", *images]
    done = starter.run(folder, "match", *arguments, "output=undisturbed")
    assert done.status == 0, done.said()
    truth, killed = match_result(folder / "undisturbed"), 0
    for i, later in enumerate(islice(delays(seed), 10 * kills)):
        output = folder / f"out{i}"
        command = starter.start(folder, "match", *arguments, f"output={output}")
        if not command.kill_when((output / "result.json").exists, later):
            assert command.wait() == 0, command.said()
            continue
        killed += 1
        json.loads((output / "result.json").read_text())  # whole
        again = starter.run(folder, "match", *arguments, f"output={output}")
        assert again.status == 0, again.said()
        assert match_result(output) == truth
        if killed == kills:
            break
    return killed


@pytest.mark.parametrize("kills", bounded_and_whole(1, MATCH_KILLS))
def test_two_photographs_are_matched_again(kills, starter, root, tmp_path, record_property):
    killed = match_with_kills(starter, root, tmp_path, kills, 0)
    assert killed == kills
    record_property("kills of match", killed)


def trained(folder: Path) -> dict[str, bytes]:
    """The weights and figures of a training."""
    return {name: (folder / name).read_bytes() for name in ("lc.safetensors", "validation.json")}


def newest(folder: Path) -> int:
    """The steps of the last checkpoint, -1 where there is none."""
    return max((int(path.stem.removeprefix("step=")) for path in folder.glob("checkpoints/step=*.ckpt")), default=-1)


def train_with_kills(starter: Starter, folder: Path, kills: int, seed: int) -> int:
    """Train, killed once a later checkpoint is on disk, and again; checks that the weights are no others."""
    pytest.importorskip("lightning", reason="training needs the extra `train`")
    root = draw_set(folder / "Set", ["scene0", "scene1"], images=4)
    arguments = ["dataset=fmbench", f"dataset.root={root}", *TRAIN]
    done = starter.run(folder, "train", *arguments, "output=undisturbed")
    assert done.status == 0, done.said()
    truth, killed, wait, count = trained(folder / "undisturbed"), 0, delays(seed), 0
    while killed < kills:
        output = folder / f"out{count}"
        count += 1
        while True:
            before = newest(output)
            command = starter.start(folder, "train", *arguments, f"output={output}")
            if killed < kills and command.kill_when(lambda: newest(output) > before, next(wait)):  # noqa: B023
                killed += 1
                continue
            assert command.wait() == 0, command.said()
            break
        assert trained(output) == truth
    return killed


@pytest.mark.parametrize("kills", bounded_and_whole(1, TRAIN_KILLS))
def test_a_training_goes_on(kills: int, starter: Starter, tmp_path: Path, record_property: Property) -> None:
    killed = train_with_kills(starter, tmp_path, kills, 0)
    assert killed == kills
    record_property("kills of train", killed)
