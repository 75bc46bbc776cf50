"""Benchmarks: rows that are kept and resumed, tables, pages of settings."""

import csv
import dataclasses
import inspect
from pathlib import Path

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch import presets
from fmtorch.core import Correspondences
from fmtorch.geometry import eight_point, sampson
from fmtorch.presets import build as preset
from scripts.benchmark import estimators, methods, runner
from scripts.benchmark.methods import pipeline_of, read_specs, split, stages_of
from scripts.benchmark.pipelines import BENCHMARKS, RULE, differences_sheet, figures_sheet, settings_of
from scripts.benchmark.runner import Item, Kept, Measured, Row, measure
from scripts.benchmark.tables import FIGURES, MEDIANS, Results, Sheet, Span, published, show
from tests.helpers import draw_set
from tests.laws import PEERS, scene
from tests.reference import lenses as division
from tests.scripts.samples import item, pair, read, row, run


@dataclasses.dataclass
class Counted(Measured):
    """A method that is interrupted from its call of some number on."""

    name: str
    identity: str = "made with"
    end: int = 1000
    calls: int = 0

    def figures(self, item: Item, seed: int) -> Row:
        self.calls += 1
        if self.calls > self.end:
            raise KeyboardInterrupt
        return {"nsgd": seed + 0.5}


def items(count: int) -> list[Item]:
    return [item(pair(f"orbit/s/{i}"), scene(i, 60)) for i in range(count)]


def test_a_line_that_was_cut_off_goes_and_other_files_stay_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    Kept(path).add([{"pair": "a", "seed": 0}, {"pair": "b", "seed": 0}])
    path.write_bytes(path.read_bytes() + b'{"pair": "\xc3')
    again = Kept(path)
    again.add([{"pair": "b", "seed": 0, "new": True}])
    assert read(path) == again.rows == [{"pair": "a", "seed": 0}, {"pair": "b", "seed": 0}, again.rows[-1]]
    assert again.by("pair", "seed")["b", 0] == {"pair": "b", "seed": 0, "new": True}
    figures = tmp_path / "figures.json"
    figures.write_text('{\n"machine": 1,\n')
    with pytest.raises(SystemExit, match=r"figures\.json, line 1: no row"):
        Kept(figures)
    assert figures.read_text() == '{\n"machine": 1,\n'
    with pytest.raises(SystemExit, match=r"none/rows\.jsonl: there is no folder"):
        Kept(tmp_path / "none" / "rows.jsonl")


def test_an_interrupted_run_goes_on_and_measures_what_others_need(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    with pytest.raises(KeyboardInterrupt):
        measure([Counted("a", end=4), Counted("b")], items(3), 2, Kept(path))
    assert len(read(path)) == 6  # of the first pair both seeds, of the second one; the first call was not counted
    a, b = Counted("a"), Counted("b")
    rows = measure([a, b], items(3), 2, Kept(path))
    assert (a.calls, b.calls) == (4, 4)  # three that were missing, after one that is not counted
    assert rows == measure([Counted("a", end=0), Counted("b", end=0)], items(3), 2, Kept(path))
    assert len(rows) == len(read(path)) == 12
    for other, count, seeds in ((Counted("c"), 3, 1), (Counted("a", "otherwise"), 3, 1), (a, 4, 2), (a, 3, 3)):
        before = other.calls
        measure([other], items(count), seeds, Kept(path))
        assert other.calls > before
    elsewhere = Item(pair("orbit/s/0"), lambda: None)  # a pair of which nothing can be measured has no row
    assert measure([Counted("d", end=0)], [elsewhere], 1, Kept(None)) == []


def test_what_a_row_was_made_with_is_options_code_and_learned_files(monkeypatch: pytest.MonkeyPatch) -> None:
    def identities() -> list[str]:
        words = ["usac", "usac:threshold=0.7", "usac@ratio_prior", "poselib", "truth", "truth@lc:soft=true"]
        own = dict.fromkeys(words)
        monkeypatch.setattr(methods.presets, "build", lambda group, name, **changed: preset(group, name, **changed)
                            if name != "poselib" else None)  # fmt: skip
        return [methods.method(word).identity for word in own]

    monkeypatch.setattr(runner, "libraries", lambda others: dict.fromkeys(others, "1"))  # PoseLib may be absent
    before = identities()
    assert (len(set(before)), identities()) == (len(before), before)
    with monkeypatch.context() as patch:
        patch.setattr(runner, "code_digest", lambda module: module)
        assert not set(before[:4]) & set(identities()[:4])
    monkeypatch.setattr(runner, "libraries", lambda others: dict.fromkeys(others, "2"))
    assert identities()[3] != before[3]


def test_truth_is_the_fit_that_starts_from_the_true_matrix() -> None:
    exact = scene(0, 200, outliers=0, noise=0)
    (F,), _ = eight_point(exact.x0.double(), exact.x1.double())
    noisy = scene(0, 200, outliers=0.5, noise=0.3)
    both = [item(pair("orbit/0/0", F.numpy()), noisy), item(pair("orbit/0/1", F.flip(0).numpy()), noisy)]
    for spec in ("truth", "truth@position_consistency"):
        near, far = (row["nsgd"] for row in measure([methods.method(spec)], both, 1, Kept(None)))
        assert 1e-6 < near < 0.01, spec  # the matches' noise moves it
        assert far > 0.05, spec  # and does not bring it home from elsewhere


def test_a_table_is_markdown_here_and_one_value_a_cell_in_its_file(tmp_path, capsys):
    sheet = Sheet("poses", "Poses", [{"set": "a", "lead": Span("+1.0", "-2.0", "+3.0")}, {"set": "b", "ms": "4"}])
    show([sheet], tmp_path / "own.csv")
    lines = capsys.readouterr().out.splitlines()
    assert (lines[0], lines[4]) == ("Poses", "| a   | +1.0 [-2.0, +3.0] |     |")
    with (tmp_path / "own.csv").open() as file:
        first, second = csv.DictReader(file)
    assert first == {"set": "a", "lead": "+1.0", "lead low": "-2.0", "lead high": "+3.0", "ms": ""}
    assert second == {"set": "b", "lead": "", "lead low": "", "lead high": "", "ms": "4"}
    show([Sheet("", "All", sheet.records), sheet, Sheet("none", "None", [])], tmp_path / "all.csv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.csv", "all_poses.csv", "own.csv"]


def test_the_files_of_estimators_name_estimators_there_are() -> None:
    folder = Path(estimators.__file__).parent
    specs = [spec for curve in estimators.read_curves(read_specs(folder / "curves.txt")) for spec in curve.specs]
    for name in ("estimators.txt", "ablation.txt", "stress.txt", "unknown_cameras.txt", "overlap.txt"):
        specs += [spec.strip("()") for spec in read_specs(folder / name)]
    assert len(specs) > 80
    words = {"ngransac", "sizeless", "ratioless", "scoreless", "priorless", "part", "bent"}
    for spec in specs:
        front, changed = split(spec.partition("@")[0])
        known = presets.load("estimator", front) if front not in ("truth", "find_fundamental") else {}
        known |= inspect.signature(fmtorch.find_fundamental).parameters if front == "find_fundamental" else {}
        assert set(changed) <= {*known, "focal"}, spec
        assert {split(stage)[0] for stage in stages_of(spec)} <= {*presets.available("pruner"), *words}, spec
        if front not in PEERS and "ngransac" not in spec:
            assert methods.method(spec).name == spec
    with pytest.raises(SystemExit, match=r"'other \| ransac \| 10' is not CURVE"):
        estimators.read_curves(["other | ransac | 10"])


@pytest.mark.parametrize("name", [*BENCHMARKS, "related"])
def test_settings_name_pipelines_columns_and_figures_there_are(name: str) -> None:
    settings = settings_of(name)
    assert {*settings.get("columns", ()), *settings.get("compared", ())} <= {*FIGURES, *MEDIANS, "failed"}
    others = {word for two in settings.get("differences", ()) for word in two} - set(settings["methods"])
    named = {*presets.available("pipeline"), *(word.split()[0] for word in settings["methods"])}  # on a command line
    assert {word.split()[0] for word in others} <= named
    if "published" in settings:
        assert published(Path("scripts/benchmark") / settings["published"])
    for words in list(settings["methods"].values())[::8]:  # composing takes a while
        assert pipeline_of(words.partition(" + ")[0], "cache=off").pruners


def test_a_run_and_its_tables_are_written(tmp_path, capsys, monkeypatch):
    rows, table = tmp_path / "rows.jsonl", tmp_path / "own.csv"
    mine = "mine = sift_ratio pruner=[ratio] + lpm"
    arguments = ["--root", draw_set(tmp_path / "Set", images=3), "--seeds", 2, "--cache", "off", "--rows", rows,
                 "--pipelines", "RATIO", "GMS*", mine, "--overrides", "features.max_features=300"]  # fmt: skip
    run(capsys, monkeypatch, "pruning", *arguments)
    first = read(rows)
    assert [len([r for r in first if r["method"] == m]) for m in ("RATIO", "GMS", "GMS, scale", "mine")] == [4] * 4
    assert all(r["ok"] and r["features0"] > 50 for r in first if r["method"] == "RATIO")
    assert all((r["ms_pruning"] == 0) == (r["method"] == "RATIO") for r in first)
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


def test_recall_is_given_apart_for_pairs_that_the_rule_leaves_out(tmp_path, capsys, monkeypatch):
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


def exact_pair(size: tuple[int, int] = (480, 640)) -> Item:
    """A pair of exact matches, a quarter of them wrong, that fill both images."""
    x0, x1, F, K = division.photographs(2, (0.0, 0.0), size, noise=0.0)
    points = [torch.from_numpy(x)[None] for x in (x0, x1)]
    ratio = torch.where(torch.arange(len(x0)) < len(x0) // 4, 0.75, 0.5)[None]
    sizes = torch.tensor([size])
    c = Correspondences(*points, torch.ones(1, len(x0), dtype=torch.bool), ratio=ratio, size0=sizes, size1=sizes)
    return item(pair("orbit/s/0", F, K0=K, K1=K), c)


def measured(item: Item, *specs: str) -> list[Row]:
    return measure([methods.method(spec) for spec in specs], [item], 1, Kept(None))


def test_pairs_are_grouped_by_the_share_of_right_matches() -> None:
    shares = {"a": 0.39, "b": 0.4, "c": 1.0, "d": np.nan}  # NaN: without matches
    results = Results(row("m", f"orbit/s/{name}", inlier_rate_before=share) for name, share in shares.items())
    groups = results.groups(results.pairs(), (0.4, 0.7))
    assert groups == {
        "orbit": results.pairs(), "0 to 40 % right": ["orbit/s/a", "orbit/s/d"], "40 to 70 % right": ["orbit/s/b"],
        "70 to 100 % right": ["orbit/s/c"],
    }  # fmt: skip
    assert results.groups(results.pairs()) == {"orbit": results.pairs()}
    assert Results([]).groups([], (0.4, 0.7)) == {}


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
    assert shared < 1e-4 < pinhole
    c = methods.method(words[-1]).view(own.outcome, 0).correspondences
    bent = np.array([division.bent(x, (480, 640), lens) for x in own.matches.x0[0].numpy()])
    where = [int(np.abs(bent - x).sum(1).argmin()) for x in c.x0[0].numpy()]  # those that left the image are gone
    assert np.abs(bent[where] - c.x0[0].numpy()).max() < 1e-9
    assert (lens > 0) == (len(where) < len(bent))


def test_of_a_part_points_size_and_truth_are_its_own() -> None:
    own, spec = exact_pair(), "find_fundamental@part:left=0.25,top=0,right=1,bottom=0.5"
    view = methods.method(spec).view(own.outcome, 0)
    c = view.correspondences
    assert c.size0.tolist() == [[240, 480]]
    inside = [(x[..., 0] > 159.5) & (x[..., 1] < 239.5) for x in (own.matches.x0, own.matches.x1)]
    whole = own.matches.x0[inside[0] & inside[1]]
    assert torch.equal(c.x0[0], whole - torch.tensor([160.0, 0.0]))
    right = c.ratio == 0.5
    assert sampson(torch.from_numpy(view.pair.F)[None], c.x0, c.x1)[right].abs().max() < 1e-9
    given, truth = measured(own, spec, spec.replace("find_fundamental", "truth"))
    assert max(given["nsgd"], truth["nsgd"]) < 1e-4
    assert given["corrs_before"] == len(whole)
