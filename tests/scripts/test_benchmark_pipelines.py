"""Benchmarks that are pages of settings: commands that resume, tables beside the paper's, pairs that its rule takes."""

from pathlib import Path

import pytest

from fmtorch import presets
from scripts.benchmark.methods import pipeline_of
from scripts.benchmark.pipelines import BENCHMARKS, RULE, differences_sheet, figures_sheet, settings_of
from scripts.benchmark.runner import Row
from scripts.benchmark.tables import FIGURES, MEDIANS, Results, published
from tests.helpers import draw_set
from tests.scripts.samples import read, row, run


@pytest.mark.parametrize("name", [*BENCHMARKS, "related"])
def test_settings_name_pipelines_columns_and_figures_there_are(name: str) -> None:
    settings = settings_of(name)
    assert {*settings.get("columns", ()), *settings.get("compared", ())} <= {*FIGURES, *MEDIANS, "failed"}
    others = {word for two in settings.get("differences", ()) for word in two} - set(settings["methods"])
    assert {word.split()[0] for word in others} <= set(presets.available("pipeline"))
    if "published" in settings:
        assert published(Path("scripts/benchmark") / settings["published"])
    for words in list(settings["methods"].values())[::4]:  # composing takes a while
        assert pipeline_of(words.partition(" + ")[0], "cache=off").pruners


def test_an_interrupted_run_goes_on_and_its_tables_are_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, table = tmp_path / "rows.jsonl", tmp_path / "own.csv"
    mine = "mine = sift_ratio pruner=[ratio] + lpm"
    arguments = ["--root", draw_set(tmp_path / "Set", images=3), "--seeds", 2, "--cache", "off", "--rows", rows,
                 "--pipelines", "RATIO", "GMS*", mine, "--overrides", "features.max_features=300"]  # fmt: skip
    run(capsys, monkeypatch, "pruning", *arguments)
    first = read(rows)
    assert [len([r for r in first if r["method"] == m]) for m in ("RATIO", "GMS", "GMS, scale", "mine")] == [4] * 4
    assert all(r["ok"] and r["features0"] > 50 for r in first if r["method"] == "RATIO")
    assert all((r["ms_pruning"] == 0) == (r["method"] == "RATIO") for r in first)
    rows.write_text("\n".join(rows.read_text().splitlines()[:5]) + '\n{"cut')
    run(capsys, monkeypatch, "pruning", *arguments)
    again = {(r["method"], r["pair"], r["seed"]): r["nsgd"] for r in read(rows)}
    assert again == {(r["method"], r["pair"], r["seed"]): r["nsgd"] for r in first}
    printed = run(capsys, monkeypatch, "pruning", "--rows", rows, "--table", table)
    assert "R.05 minus RATIO" in printed
    assert len(table.read_text().splitlines()) == 5
    with pytest.raises(SystemExit, match="nothing to show: name sets with --root"):
        run(capsys, monkeypatch, "pruning", "--rows", tmp_path / "none.jsonl")


def counted(method: str, pair: str, nsgd: float, **others: object) -> Row:
    counts = {"inlier_rate": 0.75, "inlier_rate_before": 0.5, "corrs": 30, "corrs_before": 40}
    return row(method, pair, nsgd, **counts, features0=100, features1=300, **others)


def test_figures_stand_beside_the_papers() -> None:
    settings = settings_of("paper")
    rows = [counted("RANSAC", f"{family}/s{i % 6}/{i}", 0.2) for family in ("TUM", "orbit") for i in range(12)]
    rows += [counted("LMedS", f"TUM/s{i % 6}/{i}", 0.01 if i % 4 else 0.2) for i in range(12)]
    results = Results(rows)
    lines = {(line["set"], line["pipeline"]): line for line in figures_sheet(results, settings, set()).records}
    lmeds = lines["TUM", "LMedS"]
    assert lmeds["%Recall"].value == "75.0"
    assert (lmeds["paper: %Recall"], lmeds["paper's set"], lmeds["keypoints"].value) == ("69.2", "TUM", "200")
    assert (lmeds["kept, %"].value, lines["orbit", "RANSAC"]["paper's set"]) == ("75", "T&T")
    (line,) = (each for each in differences_sheet(results, settings).records if each["set"] == "TUM")
    assert (line["pipeline"], line["minus"], line["%Recall"].value) == ("LMedS", "RANSAC", "+75.0")
    assert line["paper: %Recall"] == "+11.8"  # 69.2 - 57.4


def test_recall_is_given_apart_for_pairs_that_the_rule_leaves_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    solved = {"sift_ratio": (0.01, 0.3), "sift_fmtorch": (0.01, 0.01)}  # pairs that it selects, and others
    results = Results(counted(m, f"orbit/s/{i}", solved[m][i % 2]) for m in solved for i in range(4))
    ratio, own = figures_sheet(results, settings_of("hard"), {"orbit/s/0", "orbit/s/2"}).records
    assert [ratio[f"%Recall, {part}"] for part in ("selected", "left out")] == ["100.0", "0.0"]
    assert [own[f"%Recall, {part}"] for part in ("selected", "left out")] == ["100.0", "100.0"]
    rows = tmp_path / "rows.jsonl"
    root = draw_set(tmp_path / "Set", images=2)
    run(capsys, monkeypatch, "hard", "--root", root, "--pipelines", "sift_ratio", "--seeds", 1,
        "--cache", "off", "--rows", rows)  # fmt: skip
    assert [(r["method"], r.get("selected")) for r in read(rows)] == [(RULE, True), ("sift_ratio", None)]
