"""docs/guides/own_parts.md, its parts saved in an empty folder, and the notebooks run with sound results."""

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from fmtorch import data, find_fundamental
from fmtorch.scenes import FAMILIES, Plan
from tests.conftest import own_cache
from tests.helpers import write_file
from tests.laws import scene
from tests.processes import SOURCE, run_command

PAGE = (SOURCE / "docs" / "guides" / "own_parts.md").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The page's files, and the photographs and pairs that it leaves to the reader."""
    for name, content in re.findall(r"```(?:python|yaml)\n# (\S+)\n(.*?)```", PAGE, flags=re.DOTALL):
        write_file(tmp_path / name, content)
    pair = data.load("stereo")[0]
    for name, source in (("left.png", pair.image0), ("right.png", pair.image1)):
        shutil.copyfile(source.path, tmp_path / name)
    there = {"scene": "motorcycle", "image0": "left.png", "image1": "right.png", "F": pair.F.ravel().tolist()}
    back = {"scene": "motorcycle", "image0": "right.png", "image1": "left.png", "F": pair.F.T.ravel().tolist()}
    (tmp_path / "pairs.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (there, back)))
    return tmp_path


def test_every_part_is_evaluated(folder: Path) -> None:
    (command,) = re.findall(r"```bash\n(.*?)```", PAGE, flags=re.DOTALL)
    words = shlex.split(command)
    assert words[:2] == ["fmtorch", "eval"]
    ended = run_command("eval", *words[2:], "output=run", cwd=folder)
    assert ended.returncode == 0, ended.stderr
    rows = [row for part in (folder / "run" / "pairs").glob("*.parquet") for row in pq.read_table(part).to_pylist()]
    assert sorted(row["pair"] for row in rows) == ["left.png right.png", "right.png left.png"]
    assert all(row["ok"] and row["corrs"] >= 8 and row["nsgd"] < 0.05 for row in rows), [
        (row["reason"], row["corrs"], row["nsgd"]) for row in rows
    ]
    identity = (folder / "run" / "run.json").read_text()
    for target in ("my_features.ORB", "my_matcher.MutualMatcher", "my_pruner.UsualMotion", "my_estimator.Refitted"):
        assert target in identity


@pytest.mark.parametrize("score", ["Welsch", "Triweight"])
def test_a_score_a_sampler_and_a_rule(score: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(folder))
    preset = folder / "my_conf" / "estimator" / "robust.yaml"
    preset.write_text(preset.read_text().replace("my_robust.Welsch", f"my_robust.{score}"))
    c = scene(1, 300, outliers=0.3)
    estimate = find_fundamental(c.x0, c.x1, ratio=c.ratio, estimator="robust", config_dir=folder / "my_conf")
    assert bool(estimate.ok[0])
    assert int(estimate.inliers.sum()) > 180  # of 210


NOTEBOOKS = SOURCE / "docs" / "notebooks"
SMALL = Plan(scenes=2, shots=4, pairs=4, scale=0.3)


def code(name: str) -> list[str]:
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.fixture
def run(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(tmp_path_factory.getbasetemp() / "notebooks")))  # scenes of all
    monkeypatch.setattr("fmtorch.scenes.dataset.PLANS", dict.fromkeys((("small", "test"), ("small", "train")), SMALL))
    drawn = {"indoor": FAMILIES["indoor"]}  # the quickest to draw
    monkeypatch.setattr("fmtorch.scenes.dataset.FAMILIES", drawn)
    monkeypatch.setattr("fmtorch.jobs.execution.cores", lambda: 1)  # processes would take longer than the work
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
    assert all(len(errors) == len(names["scenes"]) == 8 for errors in names["errors"].values())
    assert all(values.mean() > 20 for values in names["auc"].values())


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_is_stored_with_the_results_of_one_run(path: Path) -> None:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    run = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in run] == list(range(1, len(run) + 1))
    outputs = [output for cell in run for output in cell["outputs"]]
    assert any("image/jpeg" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)
    assert path.stat().st_size < 500_000
