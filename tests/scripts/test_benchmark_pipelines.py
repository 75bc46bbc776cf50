"""`scripts/benchmark pipelines`: rows are kept, an interrupted run goes on, tables go into a Markdown file."""

from __future__ import annotations

import json
from pathlib import Path

from scripts.benchmark.specs import features_of

from tests.pipeline.test_pipeline import draw
from tests.processes import run_command

SOURCE = Path(__file__).resolve().parents[2]


def benchmark(*arguments: str, cwd: Path) -> str:
    result = run_command("scripts.benchmark", "pipelines", *arguments, cwd=cwd)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_names_of_features_that_begin_alike_are_apart() -> None:
    names = [
        "hesaffnet_fmtorch", "hesaffnet_fast_fmtorch", "hesaffnet_gms estimator=lmeds_eight_point", "sift_lc_fmtorch",
        "sift_code_lmeds", "paper/sift_gms", "given_fmtorch",
    ]  # fmt: skip
    assert [features_of(name) for name in names] == [
        "hesaffnet", "hesaffnet_fast", "hesaffnet", "sift", "sift", "paper/sift", "given_fmtorch",
    ]  # fmt: skip


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    images = tmp_path / "Set" / "scene" / "Images"
    images.mkdir(parents=True)
    for i in range(4):
        draw(images / f"{i:08d}.png", seed=0, shift=9 * i)
    lines = [f"{i} {j} 0 0 0 0 0 -1 0 1 0" for i, j in ((0, 1), (0, 2), (1, 3))]
    (tmp_path / "Set" / "pairs_with_gt.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "Set" / "pairs_which_dataset.txt").write_text("scene/\n" * len(lines))
    options = ["--pipelines", "sift_ratio", "rootsiftpca_ratio", "rootsiftpca_gms", "--seeds", "2"]
    arguments = ["--root", str(tmp_path / "Set"), *options, "--json", str(tmp_path / "rows.jsonl")]
    benchmark(*arguments, cwd=tmp_path)
    text = (tmp_path / "rows.jsonl").read_text()
    rows = [json.loads(line) for line in text.splitlines()]
    assert len(rows) == 9
    assert all(len(row["nsgd"]) == 2 and all(row["ok"]) for row in rows)

    cut = text[: text.index("\n") + 40]  # a whole line, and one that the interruption cut off
    (tmp_path / "rows.jsonl").write_text(cut)
    benchmark(*arguments, cwd=tmp_path)
    again = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert len(again) == 9
    resumed = {(row["method"], row["pair"]): row for row in map(json.loads, again)}
    assert resumed == {(row["method"], row["pair"]): row for row in rows}

    table = tmp_path / "table.md"
    table.write_text("before\n<!-- figures -->\n<!-- end of figures -->\nafter\n")
    benchmark("--from", str(tmp_path / "rows.jsonl"), "--markdown", str(table), cwd=tmp_path)
    written = table.read_text()
    assert "### Set: 3 pairs of 1 scene, intervals over pairs" in written
    assert "| `rootsiftpca_gms` | " in written
    assert written.startswith("before")
    assert written.endswith("after\n")
