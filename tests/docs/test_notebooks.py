"""The notebooks run, cell after cell, on small rendered scenes, and their results are sound."""

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from fmtorch.scenes import Plan
from tests.conftest import own_cache

NOTEBOOKS = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
SMALL = Plan(scenes=2, shots=4, pairs=4, scale=0.3)


def code(name: str) -> list[str]:
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs a notebook as one program; returns its variables."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(tmp_path)))
    monkeypatch.setattr("fmtorch.scenes.dataset.PLANS", dict.fromkeys((("small", "test"), ("small", "train")), SMALL))
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    monkeypatch.setitem(mpl.rcParams, "backend", "agg")

    def everything(name: str) -> dict[str, Any]:
        names: dict[str, Any] = {"__name__": "__main__"}
        for i, cell in enumerate(code(name)):
            exec(compile(cell, f"{name}, cell {i}", "exec"), names)
        return names

    return everything


def test_estimate_and_draw(run: Any) -> None:
    names = run("estimate_and_draw")
    assert names["error"] < 0.005
    assert 700 < int(names["inliers"].sum()) <= len(names["x0"])
    assert bool(names["estimate"].related[0])


def test_compare_your_estimator(run: Any) -> None:
    names = run("compare_your_estimator")
    assert set(names["errors"]) == {"mine", "lmeds", "USAC_MAGSAC", "fmtorch"}
    assert all(len(errors) == len(names["pairs"]) == 8 for errors in names["errors"].values())
    assert float(np.mean(names["auc"]["fmtorch"])) > 0.2


def test_train_a_pruner(run: Any) -> None:
    names = run("train_a_pruner")
    losses = torch.tensor(names["losses"])
    assert len(losses) == 20
    assert losses[-5:].mean() < 0.8 * losses[:2].mean()
    assert set(names["errors"]) == {"no prior", "the default prior", "the network's"}
    assert all(len(errors) == len(names["scenes"]) == 16 for errors in names["errors"].values())
    assert all(values.mean() > 20 for values in names["auc"].values())


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_results(path: Path) -> None:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    assert all(
        c["outputs"] == [] and c["execution_count"] is None for c in notebook["cells"] if c["cell_type"] == "code"
    )
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
