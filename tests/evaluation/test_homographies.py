"""Runs of homographies: rows, summary, report, and what does not go together."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.data import load
from fmtorch.evaluation.statistics import homography_figures
from fmtorch.metrics import corner_error, pose_auc
from fmtorch.runs import RunFolder
from fmtorch.training import MatchedPairs
from tests.data import planes
from tests.helpers import call_command


def run(folder: Path, name: str, *words: str) -> None:
    """An evaluation of the set in a folder."""
    fixed = ("dataset=hpatches", "dataset.root=hpatches", "dataset.short_side=200", "cache=off", f"output={name}")
    with pytest.MonkeyPatch.context() as patch:
        call_command(patch, folder, "eval", "pipeline=sift_ratio", "estimator=homography", *fixed, *words)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs on two sequences, one image of which is missing."""
    folder = tmp_path_factory.mktemp("runs")
    root = planes.write_hpatches(folder / "hpatches")
    (root / "v_view/6.ppm").unlink()
    run(folder, "runs/a")
    run(folder, "runs/b", "estimator.hypotheses=250", "executor=processes", "workers=2")
    return folder


def test_rows_hold_homographies_and_corner_errors(runs: Path) -> None:
    dataset = load("hpatches", root=runs / "hpatches", short_side=200)
    pairs = {pair.identity: pair for pair in dataset}
    rows = RunFolder.load(runs / "runs/a").read().to_pylist()
    assert len(rows) == 10
    for row in rows:
        pair = pairs[row["pair"]]
        assert row["F"] is None
        assert math.isnan(row["nsgd"])
        assert row["rotation_error"] is None
        if pair.problem is not None:
            assert (row["ok"], row["corner_error"]) == (False, math.inf)
            assert row["reason"] == "no image hpatches/v_view/6.ppm"
            continue
        H, true = (torch.tensor(np.reshape(m, (3, 3))) for m in (row["H"], pair.H))
        assert row["corner_error"] == pytest.approx(float(corner_error(H, true, torch.tensor([200, 300]))))
        assert row["corner_error"] < 1
        assert row["inlier_rate"] > 0.9
    assert sum(not row["ok"] for row in rows) == 1


def test_the_summary_is_of_corner_errors(runs: Path) -> None:
    summary = json.loads((runs / "runs/a/summary.json").read_text())
    errors = torch.tensor(RunFolder.load(runs / "runs/a").read()["corner_error"].to_pylist(), dtype=torch.float64)
    overall = summary["all"]["homography"]
    assert overall["pairs"] == 10
    assert [overall[f"auc_{t}px"] for t in (1, 3, 5)] == pytest.approx(pose_auc(errors, (1, 3, 5)).tolist())
    assert summary["viewpoint"]["failures"] == 1
    assert summary["all"]["recall"] is summary["all"]["pose"] is None
    page = (runs / "runs/a/summary.md").read_text()
    assert "AUC@1 px" in page
    assert "%Recall" not in page
    assert (runs / "runs/a/recall.svg").stat().st_size > 0


def test_the_report_compares_corner_errors(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call_command(monkeypatch, runs, "report", "runs", "root=hpatches", "pictures=2", "output=report.html")
    page = (runs / "report.html").read_text()
    for part in ("AUC@3 px", "corner error threshold [px]", "inliers of H", "minus each other run", "corner error 0."):
        assert part in page
    assert "NSGD" not in page.partition("<h2>Runs")[0].partition("</style>")[2]


def test_figures_of_known_errors() -> None:
    figures = homography_figures(np.array([0.5, 2.0, np.inf, np.nan]))
    # To 1: a triangle to (0.5, 1/3), then 0.5 at 1/3.
    assert figures["auc_1px"] == pytest.approx(0.5 / 6 + 0.5 / 3)
    assert (figures["pairs"], figures["corner_error"]) == (3, 2.0)
    assert homography_figures(np.array([np.nan])) is None
    failed = homography_figures(np.array([np.inf, np.inf, 1.0]))
    assert failed["corner_error"] is None


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("estimator=lmeds", "gives fundamental matrices; a pipeline needs homography matrices here: estimator=homog"),
        ("cameras=unknown", "the data set has homography matrices, which take no export= and no cameras="),
        ("export=h5", "take no export="),
    ],
)
def test_what_does_not_go_together_is_refused(words: str, error: str, runs: Path) -> None:
    with pytest.raises(SystemExit, match=error):
        run(runs, "refused", words)
    assert not (runs / "refused").exists()


def test_homographies_need_a_set_that_has_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="gives homography matrices; a pipeline needs fundamental matrices here"):
        call_command(monkeypatch, tmp_path, "eval", "dataset=stereo", "estimator=homography", "cache=off")


def test_matches_are_not_labelled_by_homographies(runs: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the data set hpatches has homography matrices; matches are labelled by"):
        MatchedPairs(load("hpatches", root=runs / "hpatches"), "sift_ratio", root=tmp_path)
