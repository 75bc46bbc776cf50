"""What the report shows: pairs, names, curves, pictures."""

import re
import runpy
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmtorch import data, presets
from fmtorch.core import pair_key
from fmtorch.data import DataError
from fmtorch.evaluation import Section, ShownPair, picture, render, run_names, svg
from fmtorch.evaluation import report as module
from fmtorch.evaluation.report import Options, Run, find_dataset, gallery
from fmtorch.pipeline import pictures
from fmtorch.pipeline.pictures import BAD, COLOURS, GOOD, draw_epipolar_lines, draw_matches
from fmtorch.runs import PairRow, RunFolder, to_table
from tests.helpers import ROWS, compose, draw_set

DOCS = Path(__file__).resolve().parents[2] / "docs" / "guides" / "reports.md"
F = ROWS.ravel() / np.sqrt(2)


def distribution(root: Path, name: str = "Set", images: int = 3) -> Path:
    return draw_set(root / name, images=images, pairs=[(0, i) for i in range(1, images)])


def rows(root: Path, failed: bool = False) -> pa.Table:
    """Of the pairs of a set; failed: the last one is."""
    places = [(p.identity, p.key, p.family, p.scene) for p in data.load("fmbench", root=root)]
    rows = [PairRow(*place, True, nsgd=0.01 * i, F=F.tolist()) for i, place in enumerate(places)]
    return to_table([*rows[:-1], PairRow(*places[-1], False, "no keypoints in image 1")] if failed else rows)


def run(name: str, config: dict[str, Any], table: pa.Table) -> Run:
    return Run(name, RunFolder(Path(name), config), table)


def captioned(shown: list[ShownPair]) -> dict[str, list[str]]:
    return {f"{s.run} {pair.name}": [p.caption for p in s.pictures] for pair in shown for s in pair.runs}


def test_results_of_others_are_drawn_from_their_stored_F(tmp_path: Path) -> None:
    root = distribution(tmp_path)
    theirs = run("theirs", {"pipeline": "theirs"}, rows(root, failed=True))
    shown, notes = gallery([theirs], Options(5, [root]))
    (note,) = notes
    assert note.startswith("theirs is shown by the F that it stored, without its matches: its folder does not say what")
    captions = captioned(shown)
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
    assert [len(captions) for captions in captioned(shown).values()] == [1, 1]


def test_own_methods_keep_their_pictures_and_run_only_where_that_is_asked_for(tmp_path, monkeypatch):
    code = "def Mine(threshold):\n    return presets.build('estimator', 'lmeds', hypotheses=50)\n"
    (tmp_path / "own_estimator_of_a_test.py").write_text(f"from fmtorch import presets\n{code}")
    monkeypatch.syspath_prepend(tmp_path)
    root = distribution(tmp_path)
    stages = presets.stages(compose("match", ("pipeline=sift_ratio", "cache=off")))
    stages["estimator"] = {"_target_": "own_estimator_of_a_test.Mine", "threshold": 1}
    config = {"pipeline": "sift_ratio", **stages, "seed": 0, "dataset": presets.load("dataset", "fmbench")}
    mine = run("mine", config, rows(root))
    shown, notes = gallery([mine], Options(1, [root], cache="off"))
    assert "own_estimator_of_a_test" not in sys.modules
    assert "parts of your own (own_estimator_of_a_test.Mine), which a report loads with own_code=true" in notes[0]
    assert [len(captions) for captions in captioned(shown).values()] == [1]
    shown, notes = gallery([mine], Options(1, [root], own_code=True, cache="off"))
    assert notes == []
    assert [len(captions) for captions in captioned(shown).values()] == [2]  # matches too
    del sys.modules["own_estimator_of_a_test"]


def test_each_data_set_is_looked_for_in_its_own_root(tmp_path: Path) -> None:
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
    with pytest.raises(DataError, match=r"layout hloc holds no geometry: .* \(a report: root=\[FILES,SET\]\)"):
        find_dataset({**presets.load("dataset", "h5"), "layout": "hloc"}, Options(1, roots[:1]))
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


def config(pipeline: str = "sift_ratio", estimator: str = "ransac", **changes: Any) -> dict[str, Any]:
    stages = {"features": presets.load("features", "sift"), "pruner": ratio(0.8)}
    stages["estimator"] = presets.load("estimator", estimator)
    return {"pipeline": pipeline, **stages, "seed": 0, "version": "1", **changes}


def names(*configs: dict[str, Any]) -> list[str]:
    return run_names(configs, [f"{i}abcdefgh" for i in range(len(configs))])


def ratio(threshold: float) -> list[dict[str, Any]]:
    return [{"ratio": {"_target_": "a.Ratio", "threshold": threshold}}, {"one_to_one": {"_target_": "a.OneToOne"}}]


def test_names_tell_what_differs() -> None:
    assert names(config()) == ["sift_ratio"]
    assert names(config("sift_ratio"), config("sift_gms", "lmeds")) == ["sift_ratio", "sift_gms"]
    # What all runs share is left out.
    assert names(config(), config(estimator="lmeds")) == ["ransac", "lmeds"]
    assert names(config(seed=1), config(seed=2)) == ["seed=1", "seed=2"]
    assert names(config(pruner=ratio(0.8)), config(pruner=ratio(0.9))) == ["threshold=0.8", "threshold=0.9"]
    three = ["sift_ratio ransac", "sift_ratio lmeds", "sift_gms"]
    assert names(config(), config(estimator="lmeds"), config("sift_gms")) == three
    # A pipeline as it is needs no more words.
    usual = {"pipeline": "sift_ratio", **(presets.pipeline_stages("sift_ratio") or {})}
    changed = {**usual, "estimator": presets.load("estimator", "lmeds")}
    assert names(usual, changed) == ["sift_ratio", "sift_ratio lmeds"]
    assert presets.pipeline_stages("nowhere") is None
    # A method has one name on all data sets.
    runs = [config("sift_ratio"), config("sift_gms"), config("sift_ratio"), config("sift_gms"), config("sift_gms")]
    on_sets = run_names(runs, [f"{i}abcdefgh" for i in range(5)], ["a", "a", "b", "b", "b"])
    assert on_sets == ["sift_ratio", "sift_gms", "sift_ratio", "sift_gms 3abcde", "sift_gms 4abcde"]
    # Versions are told by their first digits.
    runs = [config(version=f"0.1.0+g{commit}") for commit in ("5c0279c1d2e3", "6c0279c1d2e3.dirty.0f1e2d3c4b5a")]
    assert names(*runs) == ["version=0.1.0+g5c0279c", "version=0.1.0+g6c0279c.dirty.0f1e2d3"]


def test_names_tell_options_of_one_preset_and_classes_of_ones_own() -> None:
    lmeds = presets.load("estimator", "lmeds")
    two = [{**config(), "estimator": {**lmeds, "hypotheses": n}} for n in (100, 200)]
    assert names(*two) == ["hypotheses=100", "hypotheses=200"]
    assert names(*two, config()) == ["lmeds hypotheses=100", "lmeds hypotheses=200", "ransac"]
    # Unlike its preset, though no other run has that preset.
    assert names(two[0], config()) == ["lmeds hypotheses=100", "ransac"]
    mine = {**config(), "estimator": {"_target_": "my.package.Mine", "threshold": 1.0}}
    other = {**mine, "estimator": {"_target_": "my.package.Mine", "threshold": 2.0}}
    assert names(mine, config()) == ["Mine", "ransac"]
    assert names(mine, other) == ["threshold=1.0", "threshold=2.0"]
    bare, parts = {"_target_": "my.package.Mine"}, [{"score": {"_target_": f"my.package.{name}"}} for name in "AB"]
    assert names(mine, {**mine, "estimator": bare}) == ["threshold=1.0", "Mine"]
    assert names(*({**mine, "estimator": {**bare, **part}} for part in parts)) == ["score=A", "score=B"]
    assert names({"pipeline": "theirs"}, {}) == ["theirs", "run"]
    assert names({"pipeline": "theirs"}, config("theirs"))[0] == "theirs"  # it says nothing of its stages
    # Identities tell apart what names do not: more options than a name tells.
    assert names(config(), {**config(), "learned": ["x"]}) == ["sift_ratio 0abcde", "sift_ratio 1abcde"]
    many = [{**config(), "estimator": {"_target_": "m.M", **dict.fromkeys("abcd", value)}} for value in (1, 2)]
    assert names(*many) == ["sift_ratio 0abcde", "sift_ratio 1abcde"]


def table(*families: str, nsgd: float = 0.03) -> pa.Table:
    names = [(family, i, f"{family}{i}") for family in families for i in range(6)]
    return to_table([PairRow(n, pair_key(n), f, "s", True, nsgd=nsgd * i, F=[0.1] * 9) for f, i, n in names])


TWO, MANY = ["a", "b & <c>"], [f"f{i}" for i in range(20)]


@pytest.mark.parametrize(("families", "curves"), [(TWO, ["all", *TWO]), (["a"], ["a"]), ([], []), (MANY, None)])
def test_a_run_has_a_picture_of_all_and_of_each_family(families: list[str], curves: list[str] | None) -> None:
    """The legend stands beside the curves and within the picture, however many there are."""
    root = ElementTree.fromstring(picture("a & b", table(*families)))
    width, height = map(float, root.attrib["viewBox"].split()[2:])
    texts = {text.text: text for text in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"a & b", "recall [%] at 0.05"} <= texts.keys()
    legend = {str(text).partition(" ")[2]: element for text, element in texts.items() if " " in str(text)}
    for name in curves if curves is not None else ["all", *families]:
        place = legend[name].attrib
        assert 340 < float(place["x"]) < width
        assert 0 < float(place["y"]) < height
    assert "var(" not in ElementTree.tostring(root, encoding="unicode")


def test_a_curve_is_the_share_of_pairs_below_each_threshold() -> None:
    (line,) = re.findall(r' d="M([^"]+)"', svg("t", {"run": np.array([0.01, 0.06, 0.1501, 1.0])}, ["run"]))
    x, y = np.array([point.split(",") for point in line.split("L")], float).T
    share = (y[0] - y) / (y[0] - 10)  # the margin at the top
    threshold = (x - x[0]) / (x[-1] - x[0]) * 0.2
    for at, expected in ((0.005, 0), (0.05, 0.25), (0.1, 0.5), (0.15, 0.5), (0.155, 0.75), (0.2, 0.75)):
        assert np.interp(at, threshold, share) == pytest.approx(expected, abs=1e-3)


NONE = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)


def grey(h: int, w: int) -> np.ndarray:
    return np.full((h, w, 3), 128, np.uint8)


def near(picture: np.ndarray, colour: tuple[int, int, int], tolerance: int = 60) -> np.ndarray:
    return (np.abs(picture.astype(int) - colour) <= tolerance).all(-1)


VGA = (480, 640)
SHAPES = [((640, 480), VGA), ((1, 500), VGA), ((370, 1226), (370, 1226)), ((100, 3000), (3000, 100)), ((1, 1), (1, 1))]


@pytest.mark.parametrize(("shape0", "shape1"), SHAPES)
def test_any_two_images_fit(shape0: tuple[int, int], shape1: tuple[int, int]) -> None:
    image0, image1 = grey(*shape0), grey(*shape1)[..., 0]  # one in colour, one grey
    for drawn in (draw_matches(image0, image1, *NONE), draw_epipolar_lines(image0, image1, *NONE[:2], ROWS)):
        assert drawn.dtype == np.uint8
        assert drawn.shape[0] <= pictures.HEIGHT + 1  # each of two sizes is rounded
        assert drawn.shape[1] <= pictures.WIDTH + 1
        assert drawn.shape[0] >= pictures.HEIGHT - 1 or drawn.shape[1] >= pictures.WIDTH - 1
        assert (drawn == 128).any()


def test_matches_are_drawn_between_their_points() -> None:
    x0, x1 = np.array([[10.0, 20], [60, 70]]), np.array([[30.0, 20], [60, 10]])
    picture = draw_matches(grey(80, 100), grey(80, 100), x0, x1, np.array([True, False]), height=800)
    scale, offset = 10, 1000 + 6
    assert picture.shape == (800, 2006, 3)
    # (0, 0) is the centre of the first pixel: pixel x is drawn around 10 x + 4.5.
    for x, colour in ((x0[0], GOOD), (x1[0] + [offset / scale, 0], GOOD), (x0[1], BAD), (x1[1] + [100.6, 0], BAD)):
        column, row = (x * scale + 4.5).round().astype(int)
        assert near(picture, colour)[row - 1 : row + 2, column - 1 : column + 2].any()
    ys, xs = np.nonzero(near(picture, GOOD, 30))
    assert abs(ys - 204.5).max() < 10
    assert xs.min() > 90
    assert xs.max() < offset + 320


def test_epipolar_lines_run_through_the_points_and_the_truth_is_white() -> None:
    x0, x1 = np.array([[20.0, 30], [70, 60]]), np.array([[40.0, 30], [50, 60]])
    images = np.zeros((90, 100, 3), np.uint8), np.zeros((90, 100, 3), np.uint8)
    picture = draw_epipolar_lines(*images, x0, x1, ROWS)
    scale = picture.shape[0] / 90
    for k, y in enumerate((30, 60)):
        row = round((y + 0.5) * scale - 0.5)
        drawn = near(picture, COLOURS[k], 40)[row - 1 : row + 2].any(0)
        assert drawn.mean() > 0.9  # across both images, but for the gap and the points' white rings
    # A true F whose lines are the rows 9 px below in image 1.
    T = np.array([[1.0, 0, 0], [0, 1, -9], [0, 0, 1]])
    with_truth = draw_epipolar_lines(*images, x0, x1, ROWS, truth=T.T @ ROWS)
    row = round((30 + 9 + 0.5) * scale - 0.5)
    white = near(with_truth, (255, 255, 255), 100)[row - 1 : row + 2].any(0)
    half = with_truth.shape[1] // 2 + 10
    assert 0.4 < white[half:].mean() < 0.7  # dashed
    assert not white[: half - 20].any()


def test_corners_have_their_lines_in_the_other_image() -> None:
    images = np.zeros((2, 90, 100, 3), np.uint8)
    for k in range(4):  # dots, no two of one height
        images[0, 12 + 16 * k : 14 + 16 * k, 20 * k + 10 : 20 * k + 12] = 255
        images[1, 20 + 16 * k : 22 + 16 * k, 80 - 20 * k : 82 - 20 * k] = 255
    picture = pictures.draw_epipolar_lines_of_corners(images[0], images[1], ROWS)
    half = picture.shape[1] // 2
    sides = picture[:, : half - 10], picture[:, half + 10 :]
    heights = set()
    for k in range(7):
        points, lines = sides if k < 4 else sides[::-1]
        share = near(lines, COLOURS[k], 40).mean(1)
        (row,) = np.flatnonzero(np.diff((share > 0.5).astype(int)) == 1)  # one line, which runs across
        own = np.flatnonzero(near(points, COLOURS[k], 40).any(1))
        assert abs(own.mean() - row) < 5  # px of the picture, of eleven to one of the images
        heights.add(row)
    assert len(heights) == 7
    blank = pictures.draw_epipolar_lines_of_corners(grey(50, 60), grey(50, 60), ROWS)  # no corners, nothing to draw
    assert (blank[10:-10, 10:50] == 128).all()
    for shape in ((1, 1), (1, 500), (8, 8)):
        assert pictures.draw_epipolar_lines_of_corners(grey(*shape), grey(480, 640)[..., 0], ROWS).size


finite = st.floats(-100, 100)


@given(finite, finite, st.floats(-5000, 5000), st.integers(1, 60), st.integers(1, 60))
def test_lines_end_at_the_border(a: float, b: float, c: float, h: int, w: int) -> None:
    place = pictures.Place((h, w), (0, 0), (w, h))  # drawn as large as the image is
    ends = place.clip(np.array([a, b, c]))
    norm = float(np.hypot(a, b))
    if norm < 1e-3:  # its distance from the image is beyond float64
        return
    if len(ends) == 0:
        # The line misses the image, up to rounding: all corners are on one side.
        corners = np.array([[x, y] for x in (-0.5, w - 0.5) for y in (-0.5, h - 0.5)])
        value = corners @ [a, b] + c
        assert (value > -1e-6 * norm).all() or (value < 1e-6 * norm).all()
        return
    # Rounding: coordinates of some 1e4 / norm px away from the foot, in float64.
    assert np.abs(ends @ [a, b] + c).max() <= 1e-9 * (norm * 100 + abs(c))
    assert (ends >= -0.5 - 1e-6).all()
    assert (ends <= np.array([w, h]) - 0.5 + 1e-6).all()
