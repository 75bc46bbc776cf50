"""The command that compares runs on one page: figures as computed by hand, pictures, nothing taken on trust."""

import dataclasses
import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.commands import report
from fmtorch.core import Estimate, models_dir
from fmtorch.data import read_image
from fmtorch.evaluation import Section, differing_pairs, evaluate, render, summarize, tables
from fmtorch.evaluation.report import Options, difference, rebuilt, shown_pair
from fmtorch.pipeline import Outcome, build_pipeline
from fmtorch.runs import PairRow, RunFolder, RunFolderError, to_table
from tests.commands.test_command_line import ended
from tests.commands.test_match import stereo
from tests.helpers import compose, draw, draw_set, pair
from tests.processes import run_command

SIFT = ("pipeline=sift_ratio", "features.max_features=800", "estimator.hypotheses=100")
MATCH = ("match", "a.png", "b.png", *SIFT)


def results(nsgd: list[float], scene: str = "scene") -> list[PairRow]:
    rows = [(f"{scene}/{i}", i + 1, "family", f"{scene}{i % 6}", True) for i in range(len(nsgd))]
    return [PairRow(*row, nsgd=value, F=[1.0] + [0.0] * 8) for row, value in zip(rows, nsgd, strict=True)]


def test_figures_and_differences_are_those_of_the_rows() -> None:
    first = [0.001, 0.02, 0.03, 0.2, 0.004, 0.3, 0.01, 0.02]
    second = [0.02, 0.02, 0.2, 0.2, 0.2, 0.3, 0.2, 0.02]
    runs = {"one": to_table(results(first)), "two <b>": to_table(results(second))}
    page = render("A & B", [Section("set", runs)], [["one", "set", "abc", "0.1", "0", "runs/one"]])
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    assert "A &amp; B" in text
    assert "two &lt;b&gt;" in text
    assert "<b>" not in page
    assert "75.0 [" in text  # six of eight below 0.05
    assert "37.5 [" in text
    assert f"{100 * np.mean(np.clip(1 - np.array(first) / 0.05, 0, 1)):.1f}" in text
    assert "+37.5 [" in text  # three pairs more
    assert "+25.0 [" in text  # two pairs more at 0.01
    assert "one minus each other run" in text
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)  # all that it shows is in it


def test_poses_are_shown_where_a_run_has_them() -> None:
    posed = [dataclasses.replace(r, rotation_error=2.0, translation_error=4.0) for r in results([0.01] * 4)]
    runs = {"with": to_table(posed), "without": to_table(results([0.01] * 4))}
    summaries = {name: summarize(rows) for name, rows in runs.items()}
    table = next(each for each in tables.report_tables(runs, summaries) if each.heading == "Relative pose")
    figures = dict(zip(table.head[1:], (cell.text for cell in table.rows["with"]), strict=True))
    # To 4 degrees a triangle up to the first of the four pairs, then 6 at 1.
    assert figures["AUC@10°"] == "65.0"
    assert (figures["mAA(10°)"], figures["mAP@10°"], figures["t error, folded"]) == ("70.0", "100.0", "4.00°")
    assert {cell.text for cell in table.rows["without"]} == {"–"}
    page = render("Poses", [Section("set", runs)], [])
    assert "Relative pose" in page
    assert "Relative pose" not in render("None", [Section("set", {"without": runs["without"]})], [])


def test_pairs_shown_are_those_where_runs_differ() -> None:
    first = to_table(results([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.0]))
    second = to_table(results([0.0, 0.9, 0.06, 0.0, 0.0, 0.0, 0.0, 0.8]))
    assert differing_pairs({"a": first, "b": second}, 1) == ["scene/1"]  # 0.9 is no worse than 0.8, and comes first
    # 1 and 7 are of one scene, so that two others come between them
    assert differing_pairs({"a": first, "b": second}, 3) == ["scene/1", "scene/2", "scene/6"]
    assert differing_pairs({"a": first}, 2) == ["scene/0", "scene/6"]  # the best and the worst
    assert differing_pairs({"a": first, "b": to_table(results([0.1], "else")).slice(0, 0)}, 3) == []


def test_folders_of_runs_are_listed_and_missed(tmp_path: Path) -> None:
    for name in ("a", "deep/b"):
        RunFolder.open(tmp_path / name, {"pipeline": name})
    assert report.run_folders([tmp_path]) == [tmp_path / "a", tmp_path / "deep" / "b"]
    assert report.run_folders([tmp_path / "deep" / "b", tmp_path]) == [tmp_path / "deep" / "b", tmp_path / "a"]
    with pytest.raises(RunFolderError, match="holds no run"):
        report.run_folders([tmp_path / "nowhere"])
    with pytest.raises(RunFolderError, match="no run holds results yet"):
        report.run(compose("report", (f"runs=[{tmp_path}]",)))


def test_runs_keep_the_order_given_and_folders_are_ordered_by_recall(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, nsgd in (("a", 0.2), ("b", 0.01), ("c", 0.2)):
        RunFolder.open(tmp_path / "runs" / name, {"pipeline": name}).append(results([nsgd, 0.3]))

    def order(*runs: str, by: str = "null") -> list[str]:
        words = (f"runs=[{','.join(runs)}]", f"order={by}", "output=deep/report.html", "cache=off")
        return re.findall(r'<li data-run="(\w)"', report.run(compose("report", words)).read_text())

    assert order("runs") == order("runs/a", "runs/b", "runs/c", by="recall") == ["b", "a", "c"]
    assert order("runs/c", "runs/b", "runs/a") == ["c", "b", "a"]
    assert order("runs", by="given") == ["a", "b", "c"]
    with pytest.raises(ValueError, match="order=best must be given or recall"):
        order("runs", by="best")


@pytest.mark.parametrize("order", [["ratio", "one_to_one"], ["one_to_one", "ratio"]])
def test_a_pipeline_is_drawn_again_as_it_was_and_a_difference_is_said(order: list[str], tmp_path: Path) -> None:
    first, second = (pair(name, draw(tmp_path / "a.png", 0), draw(tmp_path / "b.png", 0, shift=12)) for name in "ab")
    small = ("features.max_features=300", "estimator=lmeds", "estimator.hypotheses=100")
    config = compose("match", ("pipeline=sift_ratio", "cache=off", *small, f"pruner=[{','.join(order)}]"))
    rows = evaluate(build_pipeline(config).run([first, second], seed=3), seed=3)
    F = np.array([0, 0, 1, 0, 0, 0, -1, 0, 0]) / np.sqrt(2)  # of a vertical motion; that of the images is horizontal
    rows[1] = dataclasses.replace(rows[1], F=F.tolist(), nsgd=0.0)
    identity = {"pipeline": "sift_ratio", "seed": 3, **presets.stages(config)}
    RunFolder.open(tmp_path / "run", identity).append(rows)
    (r,) = report.named([RunFolder.load(tmp_path / "run")])
    pipeline = rebuilt(r, Options(count=3, cache="off"))
    assert list(pipeline.pruners) == order
    assert shown_pair(first, [r], {r.name: pipeline}).notes == []
    shown = shown_pair(second, [r], {r.name: pipeline})
    assert (shown.name, [(seen.run, seen.nsgd) for seen in shown.runs]) == ("b", [("sift_ratio", 0.0)])
    (note,) = shown.notes
    assert note.startswith("sift_ratio gives another F when it is drawn again: NSGD 0.")
    assert "in its run 0.0000" in note
    assert note in render("", [Section("set", {r.name: r.table}, [shown])], [])


def test_a_result_that_cannot_be_had_again_is_said(tmp_path: Path) -> None:
    shown = pair("a", draw(tmp_path / "a.png", 0), draw(tmp_path / "b.png", 0, shift=12))
    images = [read_image(source) for source in (shown.image0, shown.image1)]
    F = np.array([0, 0, 0, 0, 0, -1, 0, 1, 0]) / np.sqrt(2)
    solved, failed = {"ok": True, "nsgd": 0.0, "F": F.tolist()}, {"ok": False, "nsgd": 1.0, "F": None}
    model, yes = torch.from_numpy(F.reshape(1, 3, 3)), torch.tensor([True])
    estimate = Estimate(model, yes.expand(1, 9), yes, ("",), torch.zeros(1).long())
    lost, solution = Outcome(shown, reason="no keypoints"), Outcome(shown, estimate=estimate)
    assert "(no keypoints), unlike in its run" in difference(shown, images, solved, lost)
    assert "gives an F when it is drawn again, unlike in its run" in difference(shown, images, failed, solution)
    assert difference(shown, images, solved, solution) == difference(shown, images, failed, lost) == ""


def test_the_command_on_two_runs(tmp_path: Path, command: Callable[..., str]) -> None:
    draw_set(tmp_path / "Set", pairs=[(0, 1), (0, 2)])
    small = ("dataset=fmbench", "dataset.root=Set", "features.max_features=300", "estimator.hypotheses=100")
    for estimator in ("lmeds", "msac"):
        command("eval", *small, f"estimator={estimator}", cwd=tmp_path)
    done = run_command("report", "root=Set", "pictures=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "runs/report.html").read_text()
    assert (tmp_path / "runs/.gitignore").read_text().split() == ["report.html", ".gitignore"]
    assert "drawn again" not in page  # what is drawn is what was stored
    assert page.count("data:image/jpeg") == 2 * 2 * 2  # pairs, runs, pictures
    assert "fmbench, test: Set" in page
    assert re.search(r"pipeline <b>sift_ratio</b>", page)
    assert set(re.findall(r'<tr data-run="([^"]*)"', page)) == {"lmeds", "msac"}  # what they share is said once
    assert "estimator" not in re.sub(r"<style>.*</style>", "", page, flags=re.S).split("<h2>")[0]
    # Without the images there are figures, and why there are no pictures.
    command("report", "output=bare.html", cwd=tmp_path)
    bare = (tmp_path / "bare.html").read_text()
    assert "No pictures: fmbench needs root" in bare
    assert "data:image/jpeg" not in bare
    stored = next(tmp_path.glob("runs/*/*/run.json"))
    assert json.loads(stored.read_text())["config"]["pipeline"] == "sift_ratio"


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    for name, image in zip("ab", stereo(120, 160), strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    return tmp_path


def test_paths_with_brackets_are_printed_as_they_are_and_cached_features_take_no_seconds(photographs, command):
    """Brackets are the markup of the library that prints: `[/x]` would end a style, `[red]` begin one."""
    first, second = (command(*MATCH, "output=m[/x] [red]", cwd=photographs) for _ in range(2))
    assert "m[/x] [red]: result.json" in first
    assert (photographs / "m[/x] [red]" / "result.json").is_file()
    keypoints = [next(line for line in said.splitlines() if "keypoints" in line) for said in (first, second)]
    assert ["cached" in line for line in keypoints] == [False, True]
    assert "estimator.hypotheses=100" in second.splitlines()[0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("pruner.ratio.threshold=nan", "pruner.ratio.threshold=nan; it must be a number of at least 0"),
        ("pruner.ratio.threshold=-1", "pruner.ratio.threshold=-1; it must be a number of at least 0"),
        ("features.max_features=-5", "features.max_features=-5; it must be a whole number of at least 1"),
        ("truth=F.txt", "F.txt: holds 3 numbers"),
        ("truth=I.txt", "I.txt: a matrix of rank three (its determinant is not 0); F has rank two"),
        ("output=a.png", "a.png: File exists"),
        ("pruner=[ratio,lc] pruner.lc.file=bad.onnx", "bad.onnx is no ONNX network that can be run"),
        ("features=hardnet features.descriptor={name:hardnet,network:bad.onnx}", "bad.onnx is no ONNX network"),
    ],
)
def test_before_any_work(monkeypatch: pytest.MonkeyPatch, photographs: Path, words: str, said: str) -> None:
    (photographs / "I.txt").write_text("1 0 0  0 1 0  0 0 1")
    (photographs / "F.txt").write_text("1 2 3")
    (photographs / "bad.onnx").write_bytes((models_dir() / "lc_f.onnx").read_bytes()[:5000])
    monkeypatch.setattr("fmtorch.commands.match.match", lambda *_, **__: pytest.fail("the work was begun"))
    end = ended(monkeypatch, photographs, *MATCH, *words.split())
    assert end.startswith("error: ")
    assert said in end
    assert "\n" not in end


def test_the_report_is_refused_before_it_is_drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    RunFolder.open(tmp_path / "run", {})
    monkeypatch.setattr("fmtorch.commands.report.gallery", lambda *_: pytest.fail("the work was begun"))
    monkeypatch.setattr("fmtorch.commands.report.named", lambda _: [])
    end = ended(monkeypatch, tmp_path, "report", "runs=run", "output=run")
    assert end == "error: output=run is a folder; it must name a file"


@pytest.mark.parametrize("words", [("--config-dir", "my conf"), ("--config-dir=my conf",)])
def test_a_training_says_how_its_file_is_used(words: tuple[str, ...]) -> None:
    """As a prior, with the presets that the training had."""
    pytest.importorskip("lightning")
    from fmtorch.training.run import use_line

    said = use_line("mine", Path("runs/a b.onnx"), ["pruner=mine", *words])
    assert shlex.split(said) == [
        "python", "-m", "fmtorch.eval", "--config-dir", "my conf", "pipeline=sift_ratio", "estimator=fmtorch",
        "pruner=[ratio,one_to_one,mine]", "++pruner.mine.file=runs/a b.onnx", "++pruner.mine.soft=true",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["lc", "lc_e", "lc_side", "dfe"])
def test_the_line_that_a_training_ends_with_builds_a_pipeline(name: str) -> None:
    pytest.importorskip("lightning")
    from fmtorch.training.run import use_line

    file = models_dir() / f"{presets.load('pruner', name)['file']}.safetensors"
    said = shlex.split(use_line(name, file, [f"pruner={name}"]))
    pruners = build_pipeline(compose("eval", [*said[3:], "cache=off"])).pruners
    assert list(pruners) == ["ratio", "one_to_one", name]
    assert (pruners[name].threshold, pruners[name].prior) == (None, True)
