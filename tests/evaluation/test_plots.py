from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from matplotlib import image as mpimg

from fmtorch.core.types import pair_key
from fmtorch.evaluation import plots
from fmtorch.runs import PairRow, to_table


def table(*families: str, nsgd: float = 0.03) -> pa.Table:
    rows = [
        PairRow(pair=f"{f}{i}", key=pair_key(f"{f}{i}"), family=f, scene="s", ok=True, nsgd=nsgd * i, F=[0.1] * 9)
        for f in families
        for i in range(6)
    ]
    return to_table(rows)


@pytest.mark.parametrize(
    "runs",
    [
        {"one run": table("a", "b", "c", "d")},
        {"one run": table("a")},
        {"x": table("a", "b"), "y": table("b", "c", "d", "e")},
        {f"run {i}": table("a", nsgd=0.01 * i) for i in range(9)},
        {"empty": table()},
        {"x": table(), "y": table()},
    ],
)
def test_writes_a_picture(tmp_path: Path, runs: dict[str, pa.Table]) -> None:
    plots.plot_recall_curves(runs, tmp_path / "recall.png")
    picture = mpimg.imread(tmp_path / "recall.png")
    assert min(picture.shape[:2]) > 400
    assert [p.name for p in tmp_path.iterdir()] == ["recall.png"]


def test_panels_and_curves() -> None:
    panels = plots._panels({"run": table("a", "b")})
    assert {title: list(curves) for title, curves in panels.items()} == {"run": ["a", "b", "all"]}
    assert len(panels["run"]["all"]) == 12
    single = plots._panels({"run": table("a")})
    assert {title: list(curves) for title, curves in single.items()} == {"run": ["a"]}
    many = plots._panels({"x": table("a", "b"), "y": table("b", "c")})
    assert {title: list(curves) for title, curves in many.items()} == {"a": ["x"], "b": ["x", "y"], "c": ["y"]}


def test_curve_values() -> None:
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    plots._draw(ax, "t", {"run": np.array([0.01, 0.06, 0.1501, 1.0])})
    curve = next(line for line in ax.get_lines() if len(line.get_xdata()) > 2)
    x, y = np.asarray(curve.get_xdata()), np.asarray(curve.get_ydata())
    assert (y[0], y[-1]) == (0, 75)
    for threshold, expected in ((0.05, 25), (0.1, 50), (0.15, 50), (0.155, 75)):
        assert y[np.abs(x - threshold).argmin()] == expected
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["25.0  run"]


def test_no_curve_is_hidden_by_the_legend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (drawn.append(self), save(self, *a, **k))[1])
    for runs in (
        {"one run": table("a", "b", "c", "d")},
        {f"a run of a long name {i}": table("a", "b") for i in range(9)},
    ):
        plots.plot_recall_curves(runs, tmp_path / "recall.png")
        for ax in drawn[-1].axes:
            if ax.get_legend() is not None:
                legend = ax.get_legend().get_window_extent()
                assert not any(legend.overlaps(other.get_window_extent()) for other in drawn[-1].axes)
                assert legend.x1 <= drawn[-1].bbox.x1 + 1


def test_matplotlib_is_loaded_only_when_drawing() -> None:
    code = "import sys, fmtorch.evaluation.plots; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=False).returncode == 0
