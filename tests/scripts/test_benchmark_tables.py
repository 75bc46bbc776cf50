"""Tables of benchmarks: their intervals, groups, CSV files, curves with knees, figures."""

import csv
from pathlib import Path

import numpy as np
import pytest

from fmtorch import presets
from fmtorch.evaluation.statistics import bootstrap_mean, share_difference
from scripts.benchmark import estimators
from scripts.benchmark.methods import options, read_specs, split, stages_of
from scripts.benchmark.tables import Results, Sheet, Span, show
from tests.scripts.samples import row

FOLDER = Path(estimators.__file__).parent


def results(scenes: int = 12, families: tuple[str, ...] = ("orbit",), seeds: int = 2, pairs: int = 48) -> Results:
    """Two methods with other errors and times."""
    rng = np.random.default_rng(0)
    return Results(
        row(method, f"{family}/s{i % scenes}/{i}", rng.uniform(0, 0.08), seed, ms=ms)
        for method, ms in (("ours", 1.0), ("theirs", 2.0)) for family in families
        for i in range(pairs) for seed in range(seeds)
    )  # fmt: skip


@pytest.mark.parametrize(("scenes", "over"), [(3, "pairs"), (12, "scenes")])
def test_intervals_are_those_of_every_other_table(scenes: int, over: str) -> None:
    own = results(scenes)
    a, b = (own.get(method, own.pairs())("nsgd") for method in ("ours", "theirs"))
    areas = [100 * np.clip(1 - nsgd / 0.05, 0, 1).mean(0) for nsgd in (a, b)]
    expected = bootstrap_mean(areas[0] - areas[1], own.scenes(own.pairs()))
    found = own.difference("ours", "theirs", own.pairs(), "AUC@0.05")
    assert found == Span(*(f"{value:+.1f}" for value in (expected.value, expected.low, expected.high)))
    shares = share_difference((a < 0.01).mean(0), (b < 0.01).mean(0), own.scenes(own.pairs()))
    fine = own.difference("ours", "theirs", own.pairs(), "R.01")
    assert fine == Span(*(f"{100 * value:+.1f}" for value in (shares.value, shares.low, shares.high)))
    assert own.cell("theirs", own.pairs(), "AUC@0.05") == f"{areas[1].mean():.1f}"
    assert own.described(own.pairs()) == f"48 pairs of {scenes} scenes, intervals over {over}"
    assert own.difference("ours", "ours", own.pairs(), "R.01") == ""
    assert own.difference("ours", "theirs", own.pairs()[:3], "AUC@0.05") == ""  # too few
    assert own.time_ratio("theirs", "ours", own.pairs()) == "2.00"


def test_a_table_is_markdown_here_and_one_value_a_cell_in_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = Sheet("poses", "Poses", [{"set": "a", "lead": Span("+1.0", "-2.0", "+3.0")}, {"set": "b", "ms": "4"}])
    show([sheet], tmp_path / "own.csv")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Poses"
    assert lines[4] == "| a   | +1.0 [-2.0, +3.0] |     |"
    with (tmp_path / "own.csv").open() as file:
        first, second = csv.DictReader(file)
    assert first == {"set": "a", "lead": "+1.0", "lead low": "-2.0", "lead high": "+3.0", "ms": ""}
    assert second == {"set": "b", "lead": "", "lead low": "", "lead high": "", "ms": "4"}
    show([Sheet("", "All", sheet.records), sheet, Sheet("none", "None", [])], tmp_path / "all.csv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.csv", "all_poses.csv", "own.csv"]


def test_the_files_of_estimators_name_estimators_there_are() -> None:
    specs = [spec for curve in estimators.read_curves(read_specs(FOLDER / "curves.txt")) for spec in curve.specs]
    for name in ("estimators.txt", "ablation.txt", "stress.txt"):
        specs += [spec.strip("()") for spec in read_specs(FOLDER / name)]
    assert len(specs) > 80
    for spec in specs:
        front = spec.partition("@")[0]
        known = presets.load("estimator", split(front)[0]) if not front.startswith("truth") else {}
        assert {key.split(".")[0] for key in options(front.partition(":")[2])} <= {*known, "focal"}, spec
        assert set(stages_of(spec)) <= {*presets.available("pruner"), "ngransac", "sizeless", "ratioless"}, spec
    with pytest.raises(SystemExit, match=r"'other \| ransac \| 10' is not CURVE"):
        estimators.read_curves(["other | ransac | 10"])
