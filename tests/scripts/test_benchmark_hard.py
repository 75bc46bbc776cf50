"""`scripts/benchmark hard`: recall apart for pairs that the paper's rule selects and leaves out, from kept rows."""

from __future__ import annotations

import json
from pathlib import Path

from scripts.benchmark.hard import RULE, tables

from tests.processes import run_command


def rows() -> list[dict[str, object]]:
    """Four pairs of two scenes with two seeds; one pipeline solves those that the rule selects, the other all."""
    table: list[dict[str, object]] = []
    for i, matchable in enumerate((True, False, True, False)):
        place = {"pair": f"orbit/{i}", "family": "orbit", "scene": f"s{i // 2}"}
        table.append({"method": RULE, "identity": "", **place, "matchable": matchable})
        for method, nsgd in (("sift_ratio", 0.01 if matchable else 0.3), ("sift_fmtorch", 0.01)):
            same = {"nsgd": [nsgd] * 2, "ok": [True] * 2, "corrs_before": [50 + i] * 2}
            table.append({"method": method, "identity": "", **place, **same})
    return table


def test_recall_is_given_apart_for_pairs_that_the_rule_leaves_out() -> None:
    family, differences = tables(rows())
    assert family.title.startswith("orbit: 4 pairs of 2 scenes")
    assert family.title.endswith("the paper's rule selects 2")
    by_method = {row[0]: row for row in family.rows}
    assert list(by_method) == ["`sift_ratio`", "`sift_fmtorch`"]
    assert by_method["`sift_ratio`"][1].startswith("50.0 [")
    assert list(by_method["`sift_ratio`"][3:]) == ["100.0", "0.0", "52", "0.0"]
    assert list(by_method["`sift_fmtorch`"][3:]) == ["100.0", "100.0", "52", "0.0"]
    (row,) = differences.rows
    assert row[:2] == ["orbit: `sift_fmtorch` - `sift_ratio`", "4"]
    assert row[2].startswith("+50.0 [")


def test_kept_rows_go_between_the_marks_of_a_page(tmp_path: Path) -> None:
    (tmp_path / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows()))
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- hard pairs -->\nold\n<!-- end of hard pairs -->\nafter\n")
    result = run_command("scripts.benchmark", "hard", "--from", "rows.jsonl", "--markdown", "page.md", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    text = page.read_text()
    assert "### Paired differences on hard pairs, in points" in text
    assert "old" not in text
    assert text.startswith("before")
    assert text.endswith("after\n")
