"""The benchmark of estimators: specs, turns, tables between their markers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from fmtorch.data import ImagePair, ImageSource
from fmtorch.geometry import eight_point
from tests.laws import scene

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts" / "benchmark"


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])


def test_options_are_numbers_switches_or_words() -> None:
    import matched

    assert matched.options("a=0.5,b=true,c=null,d=focal") == {"a": 0.5, "b": True, "c": None, "d": "focal"}
    assert matched.options("") == {}


def test_tables_stand_between_their_markers(tmp_path: Path) -> None:
    import estimators
    import estimators_table
    import matched

    rng = np.random.default_rng(0)
    image = ImageSource("none", tmp_path / "none.png")  # not looked at
    families = ["orbit", "orbit", "driving", "driving"]
    pairs = [
        ImagePair(f"{family}/{i}", family, f"{family}{i}", image, image, rng.normal(size=(3, 3)))
        for i, family in enumerate(families)
    ]
    items = [(pair, scene(i, 60, outliers=0.1)) for i, pair in enumerate(pairs)]
    specs = ["ransac:hypotheses=50", "opencv_ransac", "fmtorch@position_consistency"]
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
    import estimators

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
    import estimators

    assert "KITTI" in estimators.baseline(SCRIPTS / "estimators.json")
    earlier = tmp_path / "figures.json"
    earlier.write_text('{"figures": {"KITTI": {"ransac": {"recall_05": 1.0, "mean_recall": 0.5}}}}')
    with pytest.raises(SystemExit, match=r"figures\.json has no auc_05"):
        estimators.baseline(earlier)
