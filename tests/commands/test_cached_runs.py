"""Runs with the feature cache: the same rows, killed and continued, two at once, and off."""

import re
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from fmtorch import MatchResult, match
from fmtorch.pipeline import load_pipeline
from fmtorch.runs import ArrayCache
from tests.commands.test_eval import OPTIONS, rows
from tests.helpers import draw_set
from tests.processes import Command, run_command, starter

IMAGES = 24
Rows = list[dict[str, object]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of pairs of neighbours among `IMAGES` images."""
    return draw_set(tmp_path_factory.mktemp("data") / "Set", "abc", images=IMAGES // 3)


@pytest.fixture(scope="module")
def truth(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """The rows of a run without the cache, which leaves none."""
    folder = tmp_path_factory.mktemp("off")
    run = run_command("eval", *arguments(root, folder / "run", "cache=off"), cwd=folder)
    assert run.returncode == 0, run.stderr
    assert "images computed" not in run.stdout
    kept = {path.relative_to(folder).as_posix() for path in (*folder.iterdir(), *folder.glob("cache/*"))}
    assert kept <= {"run", "cache", "cache/kernels"}  # compiled kernels are no features
    return results(folder / "run")


def arguments(root: Path, run_dir: Path, *extra: str) -> list[str]:
    return ["dataset=fmbench", f"dataset.root={root}", *OPTIONS, f"output={run_dir}", *extra]


def start(cwd: Path, log: Path, *arguments: str) -> Command:
    """The command in a process of its own; `log` and `log`.errors are what it writes."""
    return starter().start(cwd, "eval", *arguments, log=log, errors=log.with_suffix(".errors"))


def results(run_dir: Path) -> Rows:
    """The rows without what depends on the time."""
    plain = [{k: v for k, v in row.items() if not k.startswith("seconds")} for row in rows(run_dir)]
    return sorted(plain, key=lambda row: str(row["pair"]))


def counted(stdout: str) -> tuple[int, int]:
    """Images computed and found, as the run tells."""
    match = re.search(r"features of (\d+) images computed(?:, of (\d+) taken)?", stdout)
    assert match is not None, stdout
    return int(match[1]), int(match[2] or 0)


def test_the_same_rows_with_an_empty_and_with_a_damaged_cache(root: Path, truth: Rows, tmp_path: Path) -> None:
    cold = run_command("eval", *arguments(root, tmp_path / "cold"), cwd=tmp_path)
    assert cold.returncode == 0, cold.stderr
    assert counted(cold.stdout) == (IMAGES, 0)
    assert f"{IMAGES} files" in cold.stdout
    damaged = sorted(tmp_path.glob("cache/features/*/*.npz"))[0]
    damaged.write_bytes(damaged.read_bytes()[:1000])
    warm = run_command("eval", *arguments(root, tmp_path / "warm"), cwd=tmp_path)
    assert warm.returncode == 0, warm.stderr
    assert f"{damaged.name} is damaged" in warm.stderr
    assert counted(warm.stdout) == (1, IMAGES - 1)
    assert results(tmp_path / "cold") == results(tmp_path / "warm") == truth
    before, after = (
        {str(row["pair"]): row["seconds_features"] for row in rows(tmp_path / name)} for name in ("cold", "warm")
    )
    same = sum(before[pair] == after[pair] for pair in before)  # what computing took, not what reading did
    assert same >= len(before) - 2  # one image, of one or two pairs, was computed again


def test_a_killed_run_continues_with_what_it_had(root: Path, truth: Rows, tmp_path: Path) -> None:
    these = arguments(root, tmp_path / "run", "batch=1", "workers=1")
    process = start(tmp_path, tmp_path / "killed", *these)
    deadline = time.monotonic() + 120
    while len(list(tmp_path.glob("cache/features/*/*.npz"))) < 5 and time.monotonic() < deadline:
        time.sleep(0.002)
    assert process.kill()
    had = len(list(tmp_path.glob("cache/features/*/*.npz")))
    assert 5 <= had < IMAGES
    again = run_command("eval", *these, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert "damaged" not in again.stderr
    computed, from_cache = counted(again.stdout)
    assert computed == IMAGES - had
    assert from_cache > 0
    assert results(tmp_path / "run") == truth


def test_two_runs_at_once_share_the_cache(root: Path, truth: Rows, tmp_path: Path) -> None:
    names = ("a", "b")
    processes = [
        start(tmp_path, tmp_path / f"{name}.out", *arguments(root, tmp_path / name, "workers=2", "batch=3"))
        for name in names
    ]
    ended = [process.wait() for process in processes]
    outputs = [(process.log.read_text(), process.log.with_suffix(".errors").read_text()) for process in processes]
    assert ended == [0, 0], outputs
    assert all("damaged" not in err and "nothing is kept" not in err for _, err in outputs)
    assert results(tmp_path / "a") == results(tmp_path / "b") == truth
    kept = list(ArrayCache(tmp_path / "cache" / "features").files())
    assert len(kept) == IMAGES
    assert not list(tmp_path.glob("cache/features/*/*.tmp"))
    assert all(sum(counted(out)) == IMAGES for out, _ in outputs)


def test_two_photographs(root: Path, tmp_path: Path) -> None:
    images = [root / "a" / "Images" / f"{i:08d}.png" for i in (0, 1)]

    def matched(*overrides: str, longest_side: int = 1600) -> tuple[MatchResult, Any]:
        pipeline = load_pipeline("sift_gms", overrides=overrides)
        return match(*images, pipeline=pipeline, longest_side=longest_side), pipeline.extractor

    folder = f"cache={tmp_path / 'cache'}"
    (plain, _), (cold, first), (warm, second) = matched(), matched(folder), matched(folder)
    assert torch.equal(plain.F, cold.F)
    assert torch.equal(plain.F, warm.F)
    assert torch.equal(plain.keypoints0, warm.keypoints0)
    assert cold.seconds["features"] == warm.seconds["features"]
    assert (first.computed, second.found) == (2, 2)
    _, reduced = matched(folder, longest_side=200)
    assert reduced.computed == 2  # other pixels
