"""Tables of benchmarks: their intervals, groups, CSV files, curves with knees, figures."""

import csv
import inspect
from pathlib import Path

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core import Correspondences
from fmtorch.evaluation.statistics import bootstrap_mean, share_difference
from fmtorch.geometry import sampson
from scripts.benchmark import estimators
from scripts.benchmark.methods import method, read_specs, split, stages_of
from scripts.benchmark.runner import Item, Kept, Row, measure
from scripts.benchmark.tables import Results, Sheet, Span, show
from tests.reference import division
from tests.scripts.samples import item, pair, row

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
    for name in ("estimators.txt", "ablation.txt", "stress.txt", "unknown_cameras.txt"):
        specs += [spec.strip("()") for spec in read_specs(FOLDER / name)]
    assert len(specs) > 80
    words = {"ngransac", "sizeless", "ratioless", "part", "bent"}
    for spec in specs:
        front, changed = split(spec.partition("@")[0])
        known = presets.load("estimator", front) if front not in ("truth", "find_fundamental") else {}
        known |= inspect.signature(fmtorch.find_fundamental).parameters if front == "find_fundamental" else {}
        assert set(changed) <= {*known, "focal"}, spec
        assert {split(stage)[0] for stage in stages_of(spec)} <= {*presets.available("pruner"), *words}, spec
    with pytest.raises(SystemExit, match=r"'other \| ransac \| 10' is not CURVE"):
        estimators.read_curves(["other | ransac | 10"])


def exact_pair(size: tuple[int, int] = (480, 640)) -> Item:
    """A pair of exact matches, a quarter of them wrong, that fill both images."""
    x0, x1, F, K = division.photographs(2, (0.0, 0.0), size, noise=0.0)
    points = [torch.from_numpy(x)[None] for x in (x0, x1)]
    ratio = torch.where(torch.arange(len(x0)) < len(x0) // 4, 0.75, 0.5)[None]
    sizes = torch.tensor([size])
    c = Correspondences(*points, torch.ones(1, len(x0), dtype=torch.bool), ratio=ratio, size0=sizes, size1=sizes)
    return item(pair("orbit/s/0", F, K0=K, K1=K), c)


def measured(item: Item, *specs: str) -> list[Row]:
    return measure([method(spec) for spec in specs], [item], 1, Kept(None))


def test_the_public_call_is_a_method_and_gets_what_it_is_given() -> None:
    own = exact_pair()
    same = {
        "find_fundamental": "fmtorch@position_consistency",
        "find_fundamental:size0=unknown,size1=unknown": "fmtorch@sizeless+position_consistency",
        "find_fundamental:pool=12@ratioless": "fmtorch:pool=12@ratioless+position_consistency",
    }
    rows = {row["method"]: row for row in measured(own, *same, *same.values())}
    for spec, other in same.items():
        assert [rows[spec][name] for name in ("nsgd", "corrs")] == [rows[other][name] for name in ("nsgd", "corrs")]
    assert len({row["identity"] for row in rows.values()}) == len(rows)
    c = own.matches
    assumed = fmtorch.find_fundamental(c.x0, c.x1, ratio=c.ratio, key=c.key)
    assert assumed.sizes is not None
    (alone,) = measured(own, "find_fundamental@sizeless")
    assert (alone["corrs"], alone["nsgd"] < 1e-4) == (int(assumed.inliers.sum()), True)


@pytest.mark.parametrize("lens", [-0.15, 0.1])
def test_exact_matches_that_a_known_lens_bends_give_the_error_of_unbent_ones(lens: float) -> None:
    own, bent_by = exact_pair(), f"bent:lens={lens}"
    words = [f"find_fundamental{option}@{bent_by}" for option in (f":lens={lens}", ":lens=shared", "")]
    straight, known, shared, pinhole = (row["nsgd"] for row in measured(own, "find_fundamental", *words))
    assert max(straight, known) < 5e-5  # the likely cameras have their say
    assert shared < 1e-3 < pinhole
    assert own.outcome is not None
    c = method(words[-1]).view(own.outcome).correspondences
    assert c is not None
    bent = np.array([division.bent(x, (480, 640), lens) for x in own.matches.x0[0].numpy()])
    where = [int(np.abs(bent - x).sum(1).argmin()) for x in c.x0[0].numpy()]  # those that left the image are gone
    assert np.abs(bent[where] - c.x0[0].numpy()).max() < 1e-9
    assert (lens > 0) == (len(where) < len(bent))


def test_of_a_part_points_size_and_truth_are_its_own() -> None:
    own, spec = exact_pair(), "find_fundamental@part:left=0.25,top=0,right=1,bottom=0.5"
    assert own.outcome is not None
    view = method(spec).view(own.outcome)
    c = view.correspondences
    assert c is not None
    assert c.size0 is not None
    assert c.size0.tolist() == [[240, 480]]
    inside = [(x[..., 0] > 159.5) & (x[..., 1] < 239.5) for x in (own.matches.x0, own.matches.x1)]
    whole = own.matches.x0[inside[0] & inside[1]]
    assert torch.equal(c.x0[0], whole - torch.tensor([160.0, 0.0]))
    right = c.ratio == 0.5
    assert sampson(torch.from_numpy(view.pair.F)[None], c.x0, c.x1)[right].abs().max() < 1e-9
    given, truth = measured(own, spec, spec.replace("find_fundamental", "truth"))
    assert max(given["nsgd"], truth["nsgd"]) < 1e-4
    assert given["corrs_before"] == len(whole)
