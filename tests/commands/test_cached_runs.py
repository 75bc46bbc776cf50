"""Runs with the feature cache: the same rows, killed and continued, two at once, and off."""

import re
import time
from pathlib import Path

import pytest
import torch

from fmtorch import MatchResult, match
from fmtorch.core.stages import FeatureExtractor
from fmtorch.data import load
from fmtorch.pipeline.pipeline import load_pipeline
from fmtorch.runs.feature_cache import ArrayCache, CachedFeatures
from tests.commands.test_eval import OPTIONS, evaluate, rows
from tests.commands.test_match import run_python
from tests.conftest import shared_path
from tests.helpers import draw
from tests.processes import Command, starter

IMAGES = 24
Rows = list[dict[str, object]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of pairs of neighbours among `IMAGES` images in the FM-Bench layout."""
    folder = tmp_path_factory.mktemp("data") / "Set"
    images = folder / "scene" / "Images"
    images.mkdir(parents=True)
    for i in range(IMAGES):
        draw(images / f"{i:08d}.png", seed=i // 10, shift=9 * (i % 10))
    lines = [f"{i} {i + 1} 0 0 0 0 0 -1 0 1 0" for i in range(IMAGES - 1) if i % 10 < 9]
    (folder / "pairs_with_gt.txt").write_text("\n".join(lines) + "\n")
    (folder / "pairs_which_dataset.txt").write_text("scene/\n" * len(lines))
    return folder


@pytest.fixture(scope="module")
def truth(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """The rows of a run without the cache, which leaves none."""
    folder = tmp_path_factory.mktemp("off")
    run = evaluate(*arguments(root, folder / "run", "cache=off"), cwd=folder)
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
    match = re.search(r"features of (\d+) images computed, of (\d+) taken", stdout)
    assert match is not None, stdout
    return int(match[1]), int(match[2])


def test_the_same_rows_with_an_empty_and_with_a_damaged_cache(root: Path, truth: Rows, tmp_path: Path) -> None:
    cold = evaluate(*arguments(root, tmp_path / "cold"), cwd=tmp_path)
    assert cold.returncode == 0, cold.stderr
    assert counted(cold.stdout) == (IMAGES, 0)
    assert f"{IMAGES} files" in cold.stdout
    damaged = sorted(tmp_path.glob("cache/features/*/*.npz"))[0]
    damaged.write_bytes(damaged.read_bytes()[:1000])
    warm = evaluate(*arguments(root, tmp_path / "warm"), cwd=tmp_path)
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
    again = evaluate(*these, cwd=tmp_path)
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


def test_a_cache_that_cannot_be_is_told(root: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    run = evaluate(*arguments(root, tmp_path / "run", f"cache={tmp_path / 'file'}"), cwd=tmp_path)
    assert run.returncode == 1
    assert "is a file; it must name a folder" in run.stderr


def test_two_photographs(root: Path, tmp_path: Path) -> None:
    images = [root / "scene" / "Images" / f"{i:08d}.png" for i in (0, 1)]

    def matched(*overrides: str, longest_side: int = 1600) -> tuple[MatchResult, FeatureExtractor]:
        pipeline = load_pipeline("sift_gms", overrides=overrides)
        return match(*images, pipeline=pipeline, longest_side=longest_side), pipeline.extractor

    folder = f"cache={tmp_path / 'cache'}"
    (plain, _), (cold, first), (warm, second) = matched(), matched(folder), matched(folder)
    assert torch.equal(plain.F, cold.F)
    assert torch.equal(plain.F, warm.F)
    assert torch.equal(plain.keypoints0, warm.keypoints0)
    assert cold.seconds["features"] == warm.seconds["features"]
    assert isinstance(first, CachedFeatures)
    assert isinstance(second, CachedFeatures)
    assert (first.computed, second.found) == (2, 2)
    _, reduced = matched(folder, longest_side=200)
    assert isinstance(reduced, CachedFeatures)
    assert reduced.computed == 2  # other pixels


def test_the_command_for_two_photographs_tells(root: Path, tmp_path: Path) -> None:
    images = [f"image{i}={root}/scene/Images/{i:08d}.png" for i in (0, 1)]
    command = "fmtorch", "match", "pipeline=sift_gms", *images
    assert counted(run_python("-m", *command, cwd=tmp_path).stdout) == (2, 0)
    assert len(list(tmp_path.glob("cache/features/*/*.npz"))) == 2


def test_real_pairs_are_the_same(tmp_path: Path) -> None:
    pairs = load("fmbench", root=shared_path("data/Strecha_train"))
    first_pairs = [pairs[0], pairs[1]]
    options = ["estimator=lmeds", "estimator.hypotheses=200"]
    outcomes = [
        load_pipeline("sift_ratio", overrides=[*options, f"cache={cache}"]).run(first_pairs)
        for cache in ("off", tmp_path, tmp_path)
    ]
    for off, cold, warm in zip(*outcomes, strict=True):
        assert torch.equal(off.estimate.F, cold.estimate.F)
        assert torch.equal(off.estimate.F, warm.estimate.F)
        assert cold.seconds["features"] == warm.seconds["features"]
