"""The benchmark of estimators: specs, turns, tables between their markers."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from fmtorch.data import ImagePair, ImageSource
from fmtorch.evaluation.statistics import bootstrap_mean
from fmtorch.geometry import eight_point
from scripts.benchmark import estimators, estimators_table, matched
from tests.laws import scene

FIGURES = Path(__file__).resolve().parents[2] / "scripts" / "benchmark" / "estimators.json"


def test_options_are_numbers_switches_or_words() -> None:
    assert matched.options("a=0.5,b=true,c=null,d=focal") == {"a": 0.5, "b": True, "c": None, "d": "focal"}
    assert matched.options("") == {}


def test_options_of_a_part_are_nested() -> None:
    assert matched.options("a.b=1,c=x,a.d=2") == {"a": {"b": 1, "d": 2}, "c": "x"}


def test_tables_stand_between_their_markers(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    image = ImageSource("none", tmp_path / "none.png")  # not looked at
    families = ["orbit", "orbit", "driving", "driving"]
    pairs = [
        ImagePair(f"{family}/{i}", family, f"{family}{i}", image, image, rng.normal(size=(3, 3)))
        for i, family in enumerate(families)
    ]
    items = [(pair, scene(i, 60, outliers=0.1)) for i, pair in enumerate(pairs)]
    specs = ["ransac:hypotheses=50", "opencv", "fmtorch@position_consistency"]
    results = estimators.measure(specs, items, 2)
    assert all((r["ms"] > 0).all() and r["nsgd"].shape == (2, 4) for r in results.values())
    assert (results[specs[0]]["nsgd"] > 0.01).all()  # the "true" matrices have nothing to do with the matches
    figures = {g: estimators.summaries(results, pairs, inside) for g, inside in matched.groups(pairs).items()}
    page = tmp_path / "page.md"
    page.write_text(
        "before\n<!-- a -->\nold\n<!-- end a -->\n<!-- a differences -->\n<!-- end a differences -->\nafter\n"
    )
    estimators_table.write(page, "a", figures, pairs, 2)
    text = page.read_text()
    assert text.startswith("before\n<!-- a -->\nRecall at")
    assert text.endswith("<!-- end a differences -->\nafter\n")
    assert "old" not in text
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    assert [row.split("`")[1] for row in rows] == specs * 2
    for group in ("driving (2)", "wide baselines (2)", "short baselines (2)"):
        assert group in text
    with pytest.raises(SystemExit, match="no lines <!-- b -->"):
        estimators_table.write(page, "b", figures, pairs, 2)


def test_truth_is_the_fit_that_starts_from_the_true_matrix(tmp_path: Path) -> None:
    exact = scene(0, 200, outliers=0, noise=0)
    (F,), _ = eight_point(exact.x0.double(), exact.x1.double())
    image = ImageSource("none", tmp_path / "none.png")  # not looked at
    items = [
        (ImagePair("orbit/0", "orbit", "0", image, image, F.numpy()), scene(0, 200, outliers=0.5, noise=0.3)),
        (ImagePair("orbit/1", "orbit", "0", image, image, F.flip(0).numpy()), scene(0, 200, outliers=0.5, noise=0.3)),
    ]
    for spec, result in estimators.measure(["truth", "truth@position_consistency"], items, 1).items():
        near, far = result["nsgd"][0]
        assert 1e-6 < near < 0.01, spec  # the matches' noise moves it
        assert far > 0.05, spec  # and does not bring it home from elsewhere


def test_a_baseline_from_before_the_figures_had_these_names_is_refused(tmp_path: Path) -> None:
    assert "KITTI" in estimators.baseline(FIGURES)
    earlier = tmp_path / "figures.json"
    earlier.write_text('{"figures": {"KITTI": {"ransac": {"recall_05": 1.0, "mean_recall": 0.5}}}}')
    with pytest.raises(SystemExit, match=r"figures\.json has no auc_05"):
        estimators.baseline(earlier)


def pairs_of(scenes: list[str]) -> list[ImagePair]:
    image = ImageSource("none", Path("none.png"))  # not looked at
    return [ImagePair(f"orbit/{i}", "orbit", name, image, image, np.eye(3)) for i, name in enumerate(scenes)]


@pytest.mark.parametrize(("count", "over"), [(3, "pair"), (12, "scene")])
def test_intervals_are_those_of_every_other_table_and_the_page_says_over_what(
    count: int, over: str, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    pairs = pairs_of([f"s{i % count}" for i in range(48)])
    nsgd = rng.uniform(0, 0.08, (2, 2, 48))  # two methods, two seeds
    results = {name: {"nsgd": e, "ms": np.ones((2, 48))} for name, e in zip(("ours", "theirs"), nsgd, strict=True)}
    figures = estimators.summaries(results, pairs, np.ones(48, bool))["theirs"]
    share = np.clip(1 - nsgd / 0.05, 0, 1).mean(1)
    expected = bootstrap_mean(100 * share[0] - 100 * share[1], [f"orbit/{pair.scene}" for pair in pairs])
    assert (figures["interval_over"], expected.over) == (over, over)
    assert figures["ahead_auc_05"] == pytest.approx([expected.value, expected.low, expected.high], abs=1e-9)
    assert figures["auc_05"] == pytest.approx(100 * share[1].mean())
    assert figures["recall_05"] == pytest.approx(100 * (nsgd[1] < 0.05).mean())

    page = tmp_path / "page.md"
    page.write_text("<!-- a -->\n<!-- end a -->\n<!-- a differences -->\n<!-- end a differences -->\n")
    groups = {g: estimators.summaries(results, pairs, inside) for g, inside in matched.groups(pairs).items()}
    estimators_table.write(page, "a", groups, pairs, 2)
    assert f"48 pairs of {count} scenes, intervals over {over}s" in page.read_text()


def test_a_first_method_that_is_level_with_the_next_still_shows_the_interval() -> None:
    pairs = pairs_of([f"s{i}" for i in range(12)])
    same = {"nsgd": np.full((1, 12), 0.02), "ms": np.ones((1, 12))}
    figures = estimators.summaries({"a": same, "b": same}, pairs, np.ones(12, bool))
    assert estimators_table.ahead(figures, "a") == ["", ""]
    recall, area = estimators_table.ahead(figures, "b")
    assert recall.startswith("+0.0 [-")  # twelve pairs cannot tell more
    assert area == "+0.0 [+0.0, +0.0]"
    few = estimators.summaries({"a": same, "b": same}, pairs, np.arange(12) < 3)
    assert estimators_table.ahead(few, "b")[1] == "n too small"


def test_a_split_is_the_rendered_sets_alone(tmp_path: Path) -> None:
    """`--root SET --split train`, as in the commands of the ablation and of the thresholds."""
    (tmp_path / "pairs_with_gt.txt").write_text("0 1 0 0 0 0 0 -1 0 1 0\n")
    (tmp_path / "pairs_which_dataset.txt").write_text("scene/\n")
    (tmp_path / "scene" / "Images").mkdir(parents=True)
    parser = argparse.ArgumentParser()
    matched.add_set_arguments(parser)
    (dataset,) = matched.sets_of(parser.parse_args(["--root", str(tmp_path), "--split", "train"]))
    assert len(dataset) == 1
