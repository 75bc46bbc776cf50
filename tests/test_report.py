"""The command that compares runs on one page: figures as computed by hand, pictures, nothing taken on trust."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from fmtorch import presets, report
from fmtorch.evaluation.page import Section, differing_pairs, render
from fmtorch.storage import PairRow, RunFolder, RunFolderError, to_table
from tests.test_pipeline import draw

OPTIONS = {
    "output": "deep/report.html", "title": "Runs", "pictures": 3, "root": None, "device": "cpu", "cache": "off",
    "cache_limit": None,
}  # fmt: skip


def results(nsgd: list[float], scene: str = "scene") -> list[PairRow]:
    return [
        PairRow(f"{scene}/{i}", i + 1, "family", f"{scene}{i % 6}", True, nsgd=value, F=[1.0] + [0.0] * 8)
        for i, value in enumerate(nsgd)
    ]


def test_figures_and_differences_are_those_of_the_rows() -> None:
    first = [0.001, 0.02, 0.03, 0.2, 0.004, 0.3, 0.01, 0.02]
    second = [0.02, 0.02, 0.2, 0.2, 0.2, 0.3, 0.2, 0.02]
    runs = {"one": to_table(results(first)), "two <b>": to_table(results(second))}
    page = render("A & B", [Section("set", runs)], [["one", "abc", "0.1", "0", "runs/one"]])
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    assert "A &amp; B" in text
    assert "two &lt;b&gt;" in text
    assert "<b>" not in page
    assert "75.0 [" in text  # six of eight below 0.05
    assert "37.5 [" in text
    assert f"{100 * np.mean(np.clip(1 - np.array(first) / 0.05, 0, 1)):.1f}" in text
    assert "+37.5 [" in text  # three pairs more
    assert "+25.0 [" in text  # two pairs more at 0.01
    assert "What one is ahead by" in text
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)  # all that it shows is in it


def test_one_run_is_ahead_of_none() -> None:
    page = render("One", [Section("set", {"one": to_table(results([0.01, 0.2]))})], [])
    assert "ahead" not in page
    assert 'class="best"' not in page


def test_pairs_shown_are_those_where_runs_differ() -> None:
    first = to_table(results([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.0]))
    second = to_table(results([0.0, 0.9, 0.06, 0.0, 0.0, 0.0, 0.0, 0.8]))
    assert differing_pairs({"a": first, "b": second}, 1) == ["scene/1"]  # 0.9 is no worse than 0.8, and comes first
    # 1 and 7 are of one scene, so that two others come between them
    assert differing_pairs({"a": first, "b": second}, 3) == ["scene/1", "scene/2", "scene/6"]
    assert differing_pairs({"a": first}, 2) == ["scene/0", "scene/6"]  # the best and the worst
    assert differing_pairs({"a": first, "b": to_table(results([0.1], "else")).slice(0, 0)}, 3) == []


def test_folders_of_runs_are_found_and_missed(tmp_path: Path) -> None:
    for name in ("a", "deep/b"):
        RunFolder.open(tmp_path / name, {"pipeline": name})
    assert report.run_folders([tmp_path]) == [tmp_path / "a", tmp_path / "deep" / "b"]
    assert report.run_folders([tmp_path / "deep" / "b", tmp_path]) == [tmp_path / "deep" / "b", tmp_path / "a"]
    with pytest.raises(RunFolderError, match="holds no run"):
        report.run_folders([tmp_path / "nowhere"])
    with pytest.raises(RunFolderError, match="no run holds results yet"):
        report.run(OmegaConf.create({**OPTIONS, "runs": [str(tmp_path)]}))


def test_runs_are_told_apart_by_what_differs(tmp_path: Path) -> None:
    base = {
        "pipeline": "sift_ratio", "seed": 0, "features": {"_target_": "a"}, "pruner": {"r": {"threshold": 0.8}},
        "estimator": {"_target_": "b"}, "dataset": {"name": "stereo"},
    }  # fmt: skip
    changes: dict[str, dict[str, object]] = {
        "sift_ratio seed=0 estimator._target_=b": {},
        "sift_ratio lmeds seed=1": {"seed": 1, "estimator": presets.load("estimator", "lmeds")},
        "sift_gms": {"pipeline": "sift_gms"},
    }
    folders = []
    for i, change in enumerate(changes.values()):
        folders.append(RunFolder.open(tmp_path / str(i), {**base, **change}))
        folders[-1].append(results([0.1]))
    names = [" ".join(sorted(r.name.split())) for r in report._named(folders)]
    assert names == [" ".join(sorted(name.split())) for name in changes]
    twice = [*folders, RunFolder.open(tmp_path / "twice", {**base, "learned": ["x"]})]
    twice[-1].append(results([0.1]))
    names = [r.name for r in report._named(twice)]
    assert len(set(names)) == 4
    assert names[0].split()[-1] == folders[0].identity[:6]  # nothing that a name tells differs


def test_a_run_folder_runs_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    called = tmp_path / "called"
    evil = {"_target_": "pathlib.Path.touch", "self": str(called)}
    config = {
        "pipeline": "mine", "seed": 0, "version": "0", "features": {"_target_": "fmtorch.features.OpenCVSIFT"},
        "matcher": {}, "pruner": {"a": {"inner": [evil]}}, "estimator": evil, "dataset": {"name": "stereo"},
    }  # fmt: skip
    RunFolder.open(tmp_path / "run", config).append(results([0.01, 0.2]))
    monkeypatch.setattr(report, "_images", lambda r, config: {})
    output = report.run(OmegaConf.create({**OPTIONS, "runs": ["run"]}))
    assert "pathlib.Path.touch), which a report does not load" in output.read_text()
    assert not called.exists()


def test_the_command_on_two_runs(tmp_path: Path) -> None:
    images = tmp_path / "Set" / "scene" / "Images"
    images.mkdir(parents=True)
    for i in range(3):
        draw(images / f"{i:08d}.png", seed=0, shift=9 * i)
    F = "0 0 0 0 0 -1 0 1 0"
    (tmp_path / "Set" / "pairs_with_gt.txt").write_text(f"0 1 {F}\n0 2 {F}\n")
    (tmp_path / "Set" / "pairs_which_dataset.txt").write_text("scene/\n" * 2)

    def command(*arguments: str) -> subprocess.CompletedProcess[str]:
        source = str(Path(__file__).resolve().parents[1])
        env = {**os.environ, "PYTHONPATH": source, "COLUMNS": "200", "FMTORCH_CACHE": f"{tmp_path}/cache"}
        return subprocess.run(
            [sys.executable, "-m", *arguments], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300
        )

    for estimator in ("lmeds", "msac"):
        evaluated = command(
            "fmtorch.eval", "dataset=fmbench", "dataset.root=Set", "features.max_features=300",
            f"estimator={estimator}", "estimator.hypotheses=100",
        )  # fmt: skip
        assert evaluated.returncode == 0, evaluated.stderr
    done = command("fmtorch.report", "root=Set", "pictures=2")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/jpeg") == 2 * 2 * 2  # pairs, runs, pictures
    assert "fmbench, test: Set" in page
    assert page.count("<td>sift_ratio lmeds hypotheses=100</td>") >= 3
    assert page.count("<td>sift_ratio msac hypotheses=100</td>") >= 3
    # Without the images there are figures, and why there are no pictures.
    done = command("fmtorch.report", "output=bare.html")
    assert done.returncode == 0, done.stderr
    bare = (tmp_path / "bare.html").read_text()
    assert "No pictures: fmbench needs root" in bare
    assert "data:image/jpeg" not in bare
    stored = next(tmp_path.glob("runs/*/*/run.json"))
    assert json.loads(stored.read_text())["config"]["pipeline"] == "sift_ratio"
