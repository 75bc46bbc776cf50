"""`scripts/benchmark paper`, `sweep`, `gc_ransac`: tables from known rows; the early GC-RANSAC on exact matches."""

from __future__ import annotations

import pyarrow as pa
import torch

from fmtorch.core.types import Correspondences
from fmtorch.evaluation.statistics import MIN_SCENES
from scripts.benchmark import paper_table, sweep
from scripts.benchmark.early_gc_ransac import EarlyGCRansac, eight_point, residuals, seven_point
from tests.geometry.scenes import scene

Row = paper_table.Row


def row(method: str, family: str, pair: int, nsgd: float, ok: bool = True) -> Row:
    return {
        "method": method, "family": family, "scene": str(pair % (MIN_SCENES + 1)), "pair": f"{family}/{pair}",
        "features0": 100, "features1": 300, "nsgd": [nsgd, nsgd], "ok": [ok, ok], "inlier_rate": [0.75, 0.75],
        "inlier_rate_before": [0.5, 0.5], "corrs": [30, 30], "corrs_before": [40, 40],
    }  # fmt: skip


def test_tables_put_each_figure_beside_the_papers() -> None:
    rows = []
    for family in ("TUM", "orbit"):
        for pair in range(12):
            rows += [row("paper/sift_ratio", family, pair, 0.2), row("paper/sift_ratio vlfeat", family, pair, 0.2)]
            rows.append(row("paper/sift_ratio estimator=paper/lmeds vlfeat", family, pair, 0.01 if pair % 4 else 0.2))
    sheets = paper_table.tables(rows)
    assert [sheet.title.split(":")[0] for sheet in sheets] == [
        "Matches before estimation", "TUM", "orbit", "Differences of %Recall, real pairs",
        "Differences of %Recall, rendered pairs",
    ]  # fmt: skip
    matches, tum, _, real, rendered = sheets
    assert matches.rows[0][:3] == ["TUM, VLFeat", "12", "200"]
    assert [matches.rows[0][i] for i in (4, 6, 7)] == ["316", "59.21", "TUM"]
    assert tum.rows[1][0] == "LMedS"
    assert tum.rows[1][1].startswith("75.0 [")
    assert tum.rows[1][2] == "69.2"
    assert tum.rows[1][7].startswith("75 [")
    assert tum.rows[1][8] == "50"  # 158 of 316
    assert real.columns == ["", "TUM", "TUM"]
    assert real.rows[0][1].startswith("+75.0 [")
    assert real.rows[0][2] == "+11.8"  # 69.2 - 57.4
    assert rendered.columns == ["", "orbit", "T&T"]


def test_systems_are_compared_on_the_pairs_that_both_have() -> None:
    def table(keys: range, nsgd: float) -> pa.Table:
        return pa.table({"key": list(keys), "scene": ["a"] * len(keys), "nsgd": [nsgd] * len(keys)})

    rows = {
        ("TUM", "hesaffnet_gms"): table(range(30), 0.2),
        ("TUM", "code estimator=lmeds_eight_point"): table(range(10, 50), 0.0),
        ("TUM", "sift_ratio"): table(range(50, 60), 0.0),
        ("orbit", "hesaffnet_gms"): table(range(30), 0.0),
    }
    sheet = sweep.differences(rows, ["code estimator=lmeds_eight_point"])
    (line,) = sheet.rows  # no pair in common: left out
    assert line[0] == "TUM: `hesaffnet_gms` - `code estimator=lmeds_eight_point`"
    assert line[1] == "20 pairs of 1 scene, intervals over pairs"
    assert [cell.split(" ")[0] for cell in line[2:]] == ["-100.0", "-100.0", "-100.0", "-1.1"]  # 66.4 - 67.5


def test_the_early_gc_ransac_finds_the_matches_of_the_true_model() -> None:
    s = scene(80)
    x1 = torch.cat([s.x1[:60], s.x1[60:].roll(1, 0)])  # the last twenty are wrong
    c = Correspondences(s.x0[None], x1[None], torch.ones(1, 80, dtype=torch.bool))
    estimate = EarlyGCRansac(3.0, 0.99, iterations=300, normalized=True).estimator()(c)
    assert bool(estimate.ok[0])
    assert int(estimate.inliers[0, :60].sum()) > 50
    assert int(estimate.inliers[0, 60:].sum()) < 10


def test_its_solvers_meet_exact_matches_of_a_size_that_single_precision_bears() -> None:
    s = scene(30, seed=1)
    points = (torch.cat([s.x0, s.x1], 1) / 1000).float().numpy()
    assert residuals(eight_point(points), points).max() < 0.01
    assert any(residuals(F, points).max() < 0.05 for F in seven_point(points[:7]))
