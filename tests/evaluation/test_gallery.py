"""Pictures of runs whose pipeline, images or code are not at hand."""

import re
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fmtorch import data, presets
from fmtorch.data import DataError
from fmtorch.evaluation import gallery as module
from fmtorch.evaluation.gallery import Options, Run, find_dataset, gallery
from fmtorch.evaluation.page import Section, ShownPair, render
from fmtorch.runs import PairRow, RunFolder, to_table
from tests.helpers import ROWS, compose, draw_set

DOCS = Path(__file__).resolve().parents[2] / "docs" / "guides" / "reports.md"
F = ROWS.ravel() / np.sqrt(2)


def distribution(root: Path, name: str = "Set", images: int = 3) -> Path:
    return draw_set(root / name, images=images, pairs=[(0, i) for i in range(1, images)])


def rows(root: Path, **changes: Any) -> pa.Table:
    dataset = data.load("fmbench", root=root)
    pairs = [dataset[i] for i in range(len(dataset))]
    rows = [
        PairRow(p.identity, p.key, p.family, p.scene, True, nsgd=0.01 * i, F=F.tolist()) for i, p in enumerate(pairs)
    ]
    failed = PairRow(pairs[-1].identity, pairs[-1].key, "Set", "scene", False, "no keypoints in image 1")
    return to_table([*rows[:-1], failed] if changes.get("failed") else rows)


def run(name: str, config: dict[str, Any], table: pa.Table) -> Run:
    return Run(name, RunFolder(Path(name), config), table)


def pictures(shown: list[ShownPair]) -> dict[str, list[str]]:
    return {f"{s.run} {pair.name}": [p.caption for p in s.pictures] for pair in shown for s in pair.runs}


def test_results_of_others_are_drawn_from_their_stored_F(tmp_path: Path) -> None:
    root = distribution(tmp_path)
    theirs = run("theirs", {"pipeline": "theirs"}, rows(root, failed=True))
    shown, notes = gallery([theirs], Options(5, [root]))
    assert notes == [
        "theirs is shown by the F that it stored, without its matches: its folder does not say what its pipeline was."
    ]
    captions = pictures(shown)
    assert len(captions["theirs Set/scene/0-1"]) == 1
    assert "by the stored F" in captions["theirs Set/scene/0-1"][0]
    assert captions["theirs Set/scene/0-2"] == []  # it has no F
    page = render("", [Section("set", {"theirs": theirs.table}, shown, notes)], [])
    assert page.count("data:image/jpeg") == 1
    assert "failed: no keypoints in image 1" in page


@pytest.mark.skipif(not DOCS.is_file(), reason="the documentation is in a checkout only")
def test_results_of_others_become_a_run_as_documented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    distribution(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "convert.py").write_text(code)
    runpy.run_path("convert.py", {"results": {"Set/scene/0-1": F.reshape(3, 3), "Set/scene/0-2": F.reshape(3, 3)}})
    folder = RunFolder.load("runs/theirs")
    assert folder.read()["nsgd"].to_pylist() == pytest.approx([0, 0], abs=1e-6)
    shown, _ = gallery([Run("theirs", folder, folder.read())], Options(5, [tmp_path / "Set"]))
    assert [len(captions) for captions in pictures(shown).values()] == [1, 1]


def test_own_methods_keep_their_pictures_and_run_only_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_estimator_of_a_test.py").write_text(
        "from fmtorch import presets\n"
        "loaded = True\n"
        "def Mine(threshold):\n"
        "    return presets.build('estimator', 'lmeds', hypotheses=50)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    root = distribution(tmp_path)
    stages = presets.stages(compose("match", ("pipeline=sift_ratio", "cache=off")))
    stages["estimator"] = {"_target_": "own_estimator_of_a_test.Mine", "threshold": 1}
    config = {"pipeline": "sift_ratio", **stages, "seed": 0, "dataset": presets.load("dataset", "fmbench")}
    mine = run("mine", config, rows(root))
    shown, notes = gallery([mine], Options(1, [root], cache="off"))
    assert "own_estimator_of_a_test" not in sys.modules
    assert "parts of your own (own_estimator_of_a_test.Mine), which a report loads with own_code=true" in notes[0]
    assert [len(captions) for captions in pictures(shown).values()] == [1]
    shown, notes = gallery([mine], Options(1, [root], own_code=True, cache="off"))
    assert notes == []
    assert [len(captions) for captions in pictures(shown).values()] == [2]  # matches too
    del sys.modules["own_estimator_of_a_test"]


def test_each_data_set_is_found_in_its_own_root(tmp_path: Path) -> None:
    roots = [distribution(tmp_path / "a", "A", 2), distribution(tmp_path / "b", "B", 3)]
    for root in roots:
        dataset = data.load("fmbench", root=root)
        stored = {**presets.load("dataset", "fmbench"), "digest": dataset.digest}
        assert find_dataset(stored, Options(1, roots)).digest == dataset.digest
        assert find_dataset(stored, Options(1, [tmp_path / "nowhere", *roots])).digest == dataset.digest
    with pytest.raises(DataError, match="has changed since the run, or another one lies in root"):
        find_dataset({**presets.load("dataset", "fmbench"), "digest": "other"}, Options(1, roots))
    with pytest.raises(DataError, match="fmbench needs root"):
        find_dataset({**presets.load("dataset", "fmbench"), "digest": "other"}, Options(1))
    with pytest.raises(DataError, match="one of your own, which a report loads with own_code=true"):
        find_dataset({"_target_": "pathlib.Path.touch"}, Options(1, roots))
    # A root of another data set does not hide one that needs none.
    assert len(find_dataset(presets.load("dataset", "stereo"), Options(1, roots))) == 1
    assert module._places(presets.load("dataset", "rendered"), roots) == [{}]


def test_no_pictures_are_explained(tmp_path: Path) -> None:
    root = distribution(tmp_path)
    table = rows(root)
    apart = [run("a", {}, table.slice(0, 1)), run("b", {}, table.slice(1))]
    assert gallery(apart, Options(3, [root])) == ([], ["No pictures: the runs share no pair."])
    assert gallery(apart, Options(0, [root])) == ([], [])
    other = distribution(tmp_path / "other", "Other")
    assert gallery([run("a", {}, table)], Options(3, [other])) == (
        [], ["No pictures: the data set does not hold the pairs of the runs."],
    )  # fmt: skip
