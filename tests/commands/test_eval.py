"""`fmtorch eval`: a run folder, continued and refused; failures as rows; errors."""

import dataclasses
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from fmtorch.commands import eval as command_eval
from fmtorch.data import ImagePair, load
from tests.helpers import draw_set, edit_lines, write_file

OPTIONS = ["features.max_features=500", "estimator=lmeds", "estimator.hypotheses=200"]
OWN_PRUNER = """import torch

class Mine(torch.nn.Module):
    def forward(self, c):
        return 4 - 8 * c.ratio
"""
OWN_PRESET = """_target_: fmtorch.pruning.LearnedPruner
network: {_target_: own_pruner.Mine}
threshold: 0.5
prior: false
"""
RunCommand = Callable[..., str]


@pytest.fixture
def data(tmp_path: Path) -> list[str]:
    """A set in the FM-Bench layout: three sound pairs, one whose image is broken, one with NaN in F."""
    root = draw_set(tmp_path / "Set", images=5, pairs=[(0, 1), (0, 2), (1, 3), (0, 4), (2, 3)])
    (root / "scene" / "Images" / "00000004.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    edit_lines(root / "pairs_with_gt.txt", lambda lines: [*lines[:4], lines[4].replace("-1", "nan")])
    return ["dataset=fmbench", "dataset.root=Set", *OPTIONS]


def rows(run_dir: Path) -> list[dict[str, object]]:
    return [row for part in sorted((run_dir / "pairs").glob("*.parquet")) for row in pq.read_table(part).to_pylist()]


def own(folder: Path, group: str, text: str, name: str = "mine") -> list[str]:
    write_file(folder / "my_conf" / group / f"{name}.yaml", text)
    return ["--config-dir", "my_conf"]


class OwnPairs(list[ImagePair]):
    name, digest = "own", "0"


def test_pairs_of_anybodys_data_set_are_checked() -> None:
    (pair,) = load("stereo")
    refused: list[tuple[list[ImagePair], str]] = [
        ([pair, dataclasses.replace(pair, image0=pair.image1)], f"two pairs of the identity '{pair.identity}'"),
        ([dataclasses.replace(pair, image0="a.png")], "image0 is a str; images are ImageSource"),  # type: ignore[arg-type]
        ([], "the data set own has no pairs"),
    ]
    for pairs, said in refused:
        with pytest.raises(ValueError, match=re.escape(said)):
            command_eval._pairs_of(OwnPairs(pairs))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="list is no data set: it has no name, digest"):
        command_eval._pairs_of([pair])  # type: ignore[arg-type]
    unknown = dataclasses.replace(pair, F=0 * pair.F)
    (kept,) = command_eval._pairs_of(OwnPairs([unknown]))  # type: ignore[arg-type]
    assert kept.problem == "its true F, or H, must be a finite 3 x 3 matrix that is not zero"


def test_a_run_from_start_to_end(data: list[str], command: RunCommand, tmp_path: Path) -> None:
    words, run_dir = [*data, "output=run", "batch=2"], tmp_path / "run"
    first = command("eval", *words, "limit=2", cwd=tmp_path)
    assert len(rows(run_dir)) == 2
    parts = {part: part.stat().st_mtime_ns for part in (run_dir / "pairs").glob("*.parquet")}

    # Continued: what is there stays, the rest is added.
    second = command("eval", *words, cwd=tmp_path)
    assert all(part.stat().st_mtime_ns == time for part, time in parts.items())
    everything = {str(row["pair"]): row for row in rows(run_dir)}
    assert len(everything) == len(rows(run_dir)) == 5
    assert sum(bool(row["ok"]) for row in everything.values()) == 3
    assert "earlier run" not in first
    assert "2 of 5 pairs taken from an earlier run in run" in second
    assert "00000004.png" in str(everything["Set/scene/0-4"]["reason"])
    assert "line 5" in str(everything["Set/scene/2-3"]["reason"])
    assert all(bool(row["ok"]) == (row["reason"] == "") for row in everything.values())
    summary = json.loads((run_dir / "summary.json").read_text())
    assert (summary["all"]["pairs"], summary["all"]["failures"]) == (5, 2)
    assert "%Recall" in second
    assert (run_dir / "recall.svg").read_text().startswith("<svg")
    assert not (tmp_path / "outputs").exists()  # Hydra leaves nothing of its own

    # The folder's summary is of all its rows, also where a command asks for fewer.
    shown = " ".join(command("eval", *words, "limit=2", cwd=tmp_path).split())
    assert json.loads((run_dir / "summary.json").read_text()) == summary
    assert "2 of the 5 pairs of the run" in shown
    assert "of all 5 pairs" in shown

    assert re.search("ended: .*holds another run.*seed: 0 -> 1", command("eval", *words, "seed=1", cwd=tmp_path))


def test_shards_are_one_run(data: list[str], command: RunCommand, tmp_path: Path) -> None:
    command("eval", *data, "output=whole", cwd=tmp_path)
    first = command("eval", *data, "output=run", "shard=1/2", cwd=tmp_path)
    assert "2 of 5 pairs have rows; other shards have the rest" in first
    assert "other shards" not in command("eval", *data, "output=run", "shard=2/2", cwd=tmp_path)
    unsharded, merged = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("whole", "run"))
    for group in (*unsharded.values(), *merged.values()):
        del group["seconds"]
    assert merged == unsharded


def test_an_executor_of_ones_own_by_config_dir(data: list[str], command: RunCommand, tmp_path: Path) -> None:
    words = own(tmp_path, "executor", "_target_: concurrent.futures.ThreadPoolExecutor\nmax_workers: 2\n")
    command("eval", *words, *data, "executor=mine", "output=run", cwd=tmp_path)
    assert len(rows(tmp_path / "run")) == 5
    wrong = command("eval", *words, *data, "executor=mine", "executor.max_workers=two", cwd=tmp_path)
    assert "ended: error: executor: it cannot be made (TypeError: " in wrong


@pytest.mark.parametrize("header", ["", "# @package pruner.mine\n"])
def test_a_users_own_pruner_by_config_dir(header: str, data: list[str], command: RunCommand, tmp_path: Path) -> None:
    """With or without a `@package` line it goes under its file's name, in its place, and takes options by that name."""
    words = own(tmp_path, "pruner", header + OWN_PRESET)
    (tmp_path / "own_pruner.py").write_text(OWN_PRUNER)
    sys.modules.pop("own_pruner", None)
    pruners = ["pruner=[one_to_one,mine,likely]", "pruner.mine.prior=true"]
    command("eval", *words, *pruners, *data, "output=run", "limit=2", cwd=tmp_path)
    config = json.loads((tmp_path / "run" / "run.json").read_text())["config"]
    assert [list(entry) for entry in config["pruner"]] == [["one_to_one"], ["mine"], ["likely"]]
    assert config["pruner"][1]["mine"]["prior"] is True
    assert "own_pruner.Mine" in config["code"]
    assert all(row["ok"] for row in rows(tmp_path / "run"))


def test_a_data_set_that_is_something_else(data: list[str], command: RunCommand, tmp_path: Path) -> None:
    words = [*own(tmp_path, "dataset", "_target_: own_dataset.Numbers\n"), "dataset=mine", *OPTIONS]
    (tmp_path / "own_dataset.py").write_text("class Numbers(list):\n    name = 'numbers'\n")
    assert "ended: error: Numbers has no digest; a PairDataset has both" in command("eval", *words, cwd=tmp_path)
    numbers = "    name = digest = 'numbers'\n    def __init__(self):\n        super().__init__([1, 2])\n"
    (tmp_path / "own_dataset.py").write_text(f"class Numbers(list):\n{numbers}")
    sys.modules.pop("own_dataset", None)
    assert "ended: error: Numbers[0] is a int; the pairs of a data set are Im" in command("eval", *words, cwd=tmp_path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("pruner=binary", "binary.yaml: no text in UTF-8; a preset is a mapping in YAML"),
        ("pruner=empty", "pruner.empty: a preset is a mapping with a `_target_`"),
        ("pruner=elsewhere", "must be `# @package pruner.<name>`, or be left out"),
        ("pruner=typo", "pruner.typo: no option threshhold; there are: threshold"),
        ("pruner=lc pruner.lc.file=runs/absent", "absent.safetensors does not exist: fmtorch train pruner=lc"),
        ("dataset.root=nowhere", "nowhere: no such folder"),
        ("lens=-0.6", "it is lambda in half diagonals, from -0.45 to 0.2"),
        ("lens=[[0,0.1],[-0.6,0]]", "lens of image 1 of pair 0 is [-0.6, 0.0]"),
        ("device=cuda", "sees no CUDA device"),
        ("estimator.score=psac", "score is 'psac'"),
    ],
)
def test_what_cannot_be_run_is_reported(words, message, data, command, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    own(tmp_path, "pruner", "threshold: 0.5\n", "empty")
    (tmp_path / "my_conf" / "pruner" / "binary.yaml").write_bytes(b"\xb5\xff\x00 binary")
    own(tmp_path, "pruner", "# @package _global_\npruner: {_target_: fmtorch.pruning.OneToOne}\n", "elsewhere")
    folder = own(tmp_path, "pruner", "_target_: fmtorch.pruning.RatioTest\nthreshhold: 0.5\n", "typo")
    end = command("eval", *folder, *data, "output=run", "limit=1", *words.split(), cwd=tmp_path)
    assert "ended: error: " in end
    assert message in end
    assert not (tmp_path / "run").exists()


def test_a_run_in_which_nothing_succeeds_is_reported(data: list[str], command: RunCommand, tmp_path: Path) -> None:
    for image in (tmp_path / "Set" / "scene" / "Images").iterdir():
        image.write_bytes(b"no picture")
    assert "every pair failed" in command("eval", *data, "output=run", cwd=tmp_path)
    assert len(rows(tmp_path / "run")) == 5
