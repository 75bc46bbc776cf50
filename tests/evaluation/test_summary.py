import dataclasses
import json
from typing import Any

import pyarrow as pa
import pytest
import torch
from rich.console import Console

from fmtorch import metrics
from fmtorch.core import pair_key
from fmtorch.evaluation import summarize, summary_markdown, terminal_tables
from fmtorch.runs import PairRow, to_table

F = (0.0, -0.5, 0.1, 0.5, 0.0, -0.1, 0.2, 0.3, 0.59)


def good(name: str, nsgd: float, **changes: Any) -> PairRow:
    row = PairRow(
        pair=name, key=pair_key(name), family="indoor", scene="s0", ok=True, nsgd=nsgd, nsgd_released=nsgd,
        inlier_rate=0.75, inlier_rate_before=0.5, corrs=100, corrs_before=400, F=F, seconds_features=1.0,
        seconds_matching=0.5, seconds_pruning=0.0, seconds_estimation=0.25, seconds_metrics=0.125,
    )  # fmt: skip
    return dataclasses.replace(row, **changes)


def bad(name: str, reason: str = "5 matches; at least 8 are needed", **changes: Any) -> PairRow:
    row = PairRow(pair=name, key=pair_key(name), family="indoor", scene="s0", ok=False, reason=reason)
    return dataclasses.replace(row, **changes)


def known() -> pa.Table:
    return to_table(
        [
            good("a", 0.0, scene="s0"),
            good("b", 0.005, scene="s1", inlier_rate=None, corrs=0),
            good("c", 0.025, scene="s2", seconds_features=3.0),
            good("d", 0.05, scene="s3"),
            bad("e", scene="s4", inlier_rate_before=0.9, corrs_before=7, seconds_features=2.0),
            bad("f", "7 matches; at least 8 are needed", scene="s5", family="orbit"),
            bad("g", "no keypoints in a|b.png", scene="s5", family="orbit"),
            good("h", 0.049, scene="s5", family="orbit", inlier_rate=1.0, nsgd_released=None),
        ]
    )


def test_known_answer() -> None:
    summary = summarize(known())
    assert list(summary) == ["indoor", "orbit", "all"]
    indoor, orbit, everything = summary.values()
    assert (indoor["pairs"], indoor["scenes"], indoor["failures"], indoor["failure_share"]) == (5, 5, 1, 0.2)
    assert indoor["recall"] == pytest.approx(3 / 5)  # strictly below 0.05
    assert indoor["recall_fine"] == pytest.approx(2 / 5)
    assert indoor["auc_05"] == pytest.approx((1 + 0.9 + 0.5 + 0 + 0) / 5)
    assert indoor["recall_released"] == pytest.approx(3 / 5)
    assert indoor["interval_over"] == "scene"
    assert indoor["inlier_rate"] == pytest.approx(0.75)  # of the pairs that did not fail and have a rate
    assert indoor["inlier_rate_failures_0"] == pytest.approx(3 * 0.75 / 5)
    assert indoor["inlier_rate_before"] == pytest.approx(0.5)
    assert indoor["inlier_rate_before_failures_0"] == pytest.approx(4 * 0.5 / 5)
    assert indoor["corrs"] == pytest.approx(75)
    assert indoor["corrs_before"] == pytest.approx(400)
    assert indoor["seconds"]["features"] == 1.0
    assert indoor["seconds"]["total"] == 1.875
    assert orbit["interval_over"] == "pair"
    assert orbit["recall_released"] is None
    assert orbit["recall"] == pytest.approx(1 / 3)
    assert everything["recall"] == pytest.approx(4 / 8)
    assert everything["scenes"] == 6
    assert everything["reasons"] == {"5 to 7 matches; at least 8 are needed": 2, "no keypoints in a|b.png": 1}
    low, high = everything["recall_interval"]
    assert 0 <= low < everything["recall"] < high <= 1


def test_seconds_that_nobody_measured_are_not_zero() -> None:
    unmeasured = {f"seconds_{stage}": None for stage in ("features", "matching", "pruning", "estimation", "metrics")}
    assert summarize(to_table([good("a", 0.0, **unmeasured)]))["all"]["seconds"]["total"] is None


@pytest.mark.parametrize("rows", [[], [bad("a")], [good("a", 0.2)], [bad("a"), bad("b", family="x")]], ids=len)
def test_nothing_breaks_on_few_or_failed_pairs(rows: list[PairRow]) -> None:
    summary = summarize(to_table(rows))
    assert summary["all"]["pairs"] == len(rows)
    json.dumps(summary, allow_nan=False)
    assert summary_markdown(summary, title="t").startswith("# t\n")
    _render(summary, 80)


def _render(summary: dict[str, dict[str, Any]], width: int) -> str:
    console = Console(width=width, record=True, file=None, color_system=None)
    with console.capture() as capture:
        console.print(terminal_tables(summary, "sift_ratio on rendered")[0])
    return capture.get()


def test_terminal_table_fits_80_columns() -> None:
    text = _render(summarize(known()), 80)
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in text
    indoor = next(line.split() for line in lines if line.strip().startswith("indoor"))
    assert indoor[1:3] == ["5", "60.0"]
    assert {"75.0", "(50.0)", "75", "(400)"} <= set(indoor)
    assert "scenes (indoor, all); pairs (orbit)" in " ".join(text.split())


def test_markdown() -> None:
    text = summary_markdown(summarize(known()), title="sift_ratio on rendered")
    lines = text.splitlines()
    tables = [line.replace("\\|", "").count("|") for line in lines if line.startswith("|")]
    assert set(tables[:5]) == {13}
    assert set(tables[5:]) == {8}
    assert "| indoor | 5 | 5 | 60.0 [" in text
    assert "a\\|b.png" in text
    assert "1 (20.0%)" in text


def posed(name: str, rotation: float, translation: float, **changes: Any) -> PairRow:
    return good(name, 0.01, rotation_error=rotation, translation_error=translation, **changes)


def test_poses_known_answer() -> None:
    """By the larger angle, of the pairs with known cameras; a failed one is a miss."""
    failed = bad("d", rotation_error=180.0, translation_error=90.0, pose_reason="no F")
    unknown = good("e", 0.0, pose_reason="K0, K1 unknown", family="orbit")
    rows = [posed("a", 0.5, 2.0), posed("b", 4.5, 1.0), posed("c", 1.0, 12.0), failed, unknown]
    indoor, orbit, everything = summarize(to_table(rows)).values()
    assert orbit["pose"] is None
    assert everything["pose"] == indoor["pose"]
    pose = indoor["pose"]
    assert pose["pairs"] == 4
    errors = torch.tensor([2.0, 4.5, 12.0, 180.0], dtype=torch.float64)
    assert [pose[f"auc_{t}"] for t in (5, 10, 20)] == pytest.approx(metrics.pose_auc(errors).tolist())
    assert [pose[f"map_{t}"] for t in (5, 10, 20)] == pytest.approx([2 / 4, 2 / 4, (2 + 2 + 3 + 3) / 16])
    assert pose["maa_10"] == pytest.approx((0 + 1 + 1 + 1 + 6 * 2) / 40)
    assert (pose["rotation"], pose["translation"]) == (2.75, 7.0)
