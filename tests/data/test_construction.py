"""Pairs constructed from depth: candidates, overlap, splits, the command."""

import functools
import inspect
import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fmtorch import presets
from fmtorch.data import DataError, ImageSource, construction, load, read_image, to_grey
from fmtorch.data.scenes import SPLITS, AllPairs, ScenePairs, chosen, drawn, following, incidence, sharing_points
from fmtorch.pipeline import Pipeline, load_pipeline
from fmtorch.scenes import Plan, RenderedPairs
from fmtorch.training import OANetPairs
from tests.conftest import shared_path
from tests.data.native import write_colmap, write_image, write_kitti
from tests.helpers import apart, call_command, write_file
from tests.reference import labels as reference

RANGE = "it must be a list, each a number from 0 to 1: least and greatest"
COLMAP = ("count=null", "workers=1", "dataset=colmap", "dataset.sequences=[a]")
THERE = ["06", "rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg3_teddy", "Horse", "Train"]


def test_kept_pairs_of_a_real_scene_are_selected_again() -> None:
    """The column `selected` of the README of the shared data; of this scene all pairs were candidates."""
    root = shared_path("data/PhotoTourism/sacre_coeur")
    dataset = load("cameras", root=root.parent, sequences=[root.name], pairs=None)
    features = {i: construction.keypoints(to_grey(read_image(root / f"Images/{i:08d}.jpg"))) for i in range(4)}
    passed = set()
    for pair in dataset:
        i, j = map(int, pair.identity.rpartition("/")[2].split("-"))
        if j < 4 and construction.matchable(features[i], features[j], pair.F):
            passed.add((i, j))
    kept = {(int(row[0]), int(row[1])): bool(row[-1]) for row in np.loadtxt(root / "gt_check.txt") if row[1] < 4}
    assert {pair for pair, verified in kept.items() if verified} <= passed
    assert passed <= kept.keys()  # of this scene every selected pair was kept
    assert len(passed) == 4  # of six


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """Two scenes: the stereo pair, once more its left picture, noise, and a file that is no image."""
    pair = load("stereo")[0]
    halved = np.diag([0.5, 0.5, 1.0])
    images = [read_image(source) for source in (pair.image0, pair.image1)]
    pictures = [cv2.resize(image, None, fx=0.5, fy=0.5)[..., ::-1] for image in images]
    left = np.concatenate([(halved @ pair.K0).ravel(), np.eye(3).ravel(), np.zeros(3)])
    right = np.concatenate([(halved @ pair.K1).ravel(), pair.R.ravel(), pair.t])
    away = np.concatenate([left[:18], [0.1, 0.3, 0.2]])
    for name in ("a", "b"):
        images = tmp_path / "Set" / name / "Images"
        images.mkdir(parents=True)
        for i, picture in enumerate([*pictures, pictures[0]]):
            cv2.imwrite(str(images / f"{i:08d}.png"), picture)
        write_image(images / "00000003.png", size=pictures[0].shape[:2])
        (images / "00000004.jpg").write_text("no image")
        np.savetxt(tmp_path / "Set" / name / "Camera.txt", [left, right, left, away, away + 0.1])
    return tmp_path / "Set"


def run(folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    call_command(monkeypatch, folder, "pairs", "dataset=cameras", "dataset.root=Set", "output=Made", *words)


def test_the_command_makes_a_set_of_the_pairs_that_can_be_matched(scenes, tmp_path, monkeypatch, capsys):
    run(tmp_path, monkeypatch, "count=null")
    output = " ".join(capsys.readouterr().out.split())
    assert "4 pairs of 6 images; 20 of 20 candidates were judged" in output
    assert "cannot be used, the first because: " in output
    pairs = load("fmbench", root=tmp_path / "Made")
    assert [p.identity for p in pairs] == [f"Made/{scene}/{pair}" for scene in "ab" for pair in ("0-1", "1-2")]
    source = {p.identity.removeprefix("Set"): p for p in load("cameras", root=scenes)}
    for pair in pairs:
        expected = source[pair.identity.removeprefix("Made")]
        assert apart(pair.F, expected.F) < 1e-12
        for name in ("K0", "K1", "R", "t"):
            np.testing.assert_allclose(getattr(pair, name), getattr(expected, name), rtol=0, atol=1e-12)
        assert pair.image0.path.read_bytes() == expected.image0.path.read_bytes()
        assert pair.problem is None
    assert (tmp_path / "Made/a/names.txt").read_text().splitlines()[1] == "00000001 Set/a/00000001"
    assert not (tmp_path / "Made/work").exists()
    assert json.loads((tmp_path / "Made/summary.json").read_text()) == {
        "candidates": 20, "judged": 20, "kept": 4, "images": 6,
    }  # fmt: skip


def test_a_finished_set_is_not_made_again_and_another_is_refused(scenes, tmp_path, monkeypatch, capsys):
    write_file(tmp_path / "Made/notes.txt", "mine")
    with pytest.raises(SystemExit, match=r"error: Made is not empty and has no pairs\.json, .*; name another folder"):
        run(tmp_path, monkeypatch, "count=1")
    (tmp_path / "Made/notes.txt").unlink()
    run(tmp_path, monkeypatch, "count=1")
    before = (tmp_path / "Made/pairs_with_gt.txt").stat().st_mtime_ns
    monkeypatch.setattr(construction, "keypoints", None)  # nothing is judged again
    run(tmp_path, monkeypatch, "count=1")
    assert "Made is complete" in capsys.readouterr().out
    assert (tmp_path / "Made/pairs_with_gt.txt").stat().st_mtime_ns == before
    with pytest.raises(SystemExit, match=r"Made holds pairs of other settings; .*: count: 1 -> 2\. Name another"):
        run(tmp_path, monkeypatch, "count=2")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("output=null", "output is missing; it names the folder of the set that is made"),
        ("count=0", "count=0; it must be a whole number of at least 1 or null"),
        ("quality=101", "quality=101; it must be a whole number from 1 to 100"),
        ("dataset=stereo dataset.root=null", "dataset=stereo has no candidates to judge; it must be one of tum, kitti"),
        ("dataset=fmbench dataset.root=null", "fmbench needs root"),
        ("dataset=kitti", "no such folder; it must hold a folder for each sequence"),
        ("dataset.fps=0", "fps=0; it must be positive, or null for images in no order"),
        ("dataset.root=kitti", "no folder with Camera.txt, one line an image: K"),
        ("overlap=[0.4,0.1]", f"overlap=[0.4, 0.1]; {RANGE}"),
        ("overlap=[0.1,1.5]", "as [0.1,0.4], or null"),
        ("overlap=[0.1]", f"overlap=[0.1]; {RANGE}"),
        ("overlap=0.3", f"overlap=0.3; {RANGE}"),
        ("overlap=0.1..0.4", f"overlap=0.1..0.4; {RANGE}"),
        ("dataset=kitti dataset.root=kitti dataset.sequences=['06'] overlap=[0.1,0.4]", "dataset=kitti has neither"),
    ],
)
def test_a_mistake_is_reported_in_one_line_and_nothing_written(words, message, tmp_path, monkeypatch):
    write_kitti(tmp_path / "kitti")
    with pytest.raises(SystemExit, match=r"^error: ") as end:
        run(tmp_path, monkeypatch, *words.split())
    assert message in str(end.value.code)
    assert "\n" not in str(end.value.code)
    assert [path.name for path in tmp_path.iterdir()] == ["kitti"]


def test_a_draw_is_the_same_however_it_is_interrupted(scenes, tmp_path, monkeypatch):
    """Blocks of one candidate each; the first try ends after nine of them, whose verdicts are not asked for again."""
    monkeypatch.setattr("fmtorch.data.construction.BLOCK", 1)
    dataset = load("cameras", root=scenes)
    uninterrupted = construction.Construction(dataset, tmp_path / "Whole", count=3, seed=5)  # type: ignore[arg-type]
    broken = construction.Construction(dataset, tmp_path / "Made", count=3, seed=5)  # type: ignore[arg-type]
    assert sorted(uninterrupted.order().tolist()) == list(range(20))
    uninterrupted.begin()
    blocks = construction.blocks(uninterrupted.order())
    passed = [rank for number, ranks in blocks for rank in ranks if uninterrupted.judge((number, ranks)).kept[0]]
    assert len(passed) == 4
    broken.begin()
    for number, ranks in list(construction.blocks(broken.order()))[:9]:
        broken.judge((number, ranks))
    asked, matchable = list[object](), construction.matchable
    monkeypatch.setattr(construction, "matchable", lambda *given: asked.append(given) or matchable(*given))
    run(tmp_path, monkeypatch, "count=3", "seed=5", "workers=1")
    last = uninterrupted.order().tolist().index(passed[2])
    judged = [dataset.candidate(rank) for rank in uninterrupted.order()[9 : last + 1].tolist()]  # type: ignore[attr-defined]
    assert len(asked) == sum(4 not in place[1:] and place[1:] != (0, 2) for place in judged) > 0
    places = sorted(dataset.candidate(rank) for rank in passed[:3])  # type: ignore[attr-defined]
    expected = [f"Made/{'ab'[scene]}/{i}-{j}" for scene, i, j in places]
    assert [p.identity for p in load("fmbench", root=tmp_path / "Made")] == expected


def test_matches_take_the_place_of_images_in_oanets_layout(scenes, tmp_path, monkeypatch):
    """Interrupted before they are written, taken up from the matches that are kept, and read back equal."""
    words = "count=null", "layout=oanet", "workers=1", "features.max_features=500"

    def interrupted(*given: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("fmtorch.io.oanet.write", interrupted)
        with pytest.raises(SystemExit):
            run(tmp_path, patched, *words)
    assert not (tmp_path / "Made/summary.json").exists()
    dataset = load("cameras", root=scenes)
    with monkeypatch.context() as patched:
        patched.setattr("fmtorch.training.matched_pairs.write_shard", interrupted)
        run(tmp_path, patched, *words)
    assert sorted(path.name for path in (tmp_path / "Made").iterdir()) == [
        "a.hdf5", "b.hdf5", "pairs.json", "summary.json",
    ]  # fmt: skip
    written = load("h5", root=tmp_path / "Made", layout="oanet")
    loaded = load_pipeline("sift_ratio", overrides=["features.max_features=500"])
    stages = Pipeline(loaded.extractor, loaded.matcher, {}, loaded.estimator)
    source = {pair.identity: pair for pair in dataset}
    names = [f"Set/{scene}/{pair}" for scene in "ab" for pair in ("0-1", "1-2")]
    for pair, outcome in zip(written, stages.correspondences([source[name] for name in names]), strict=True):
        c, own = pair.matches().correspondences, outcome.correspondences
        assert apart(pair.F, outcome.pair.F) < 1e-6
        for name in ("x0", "x1", "ratio"):
            torch.testing.assert_close(getattr(c, name), getattr(own, name), rtol=1e-6, atol=2e-4)
        assert torch.equal(c.mutual, own.mutual)
        assert torch.equal(c.size0, own.size0)
        np.testing.assert_allclose(pair.t, outcome.pair.t / np.linalg.norm(outcome.pair.t), atol=1e-6)
    labels = {int(n) for i in range(2) for n in OANetPairs(tmp_path / "Made")[i].label.unique()}
    assert labels == {0, 1}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> ScenePairs:
    """All pairs of four photographs each of two families; cameras of the collection have other sizes."""
    root = tmp_path_factory.mktemp("rendered")
    families, plan = ["indoor", "collection"], Plan(scenes=1, shots=4, pairs=4, scale=0.1)
    return RenderedPairs(families=families, root=root, plan=plan, workers=1).scene_pairs()


def one_by_one(dataset: ScenePairs, scene: int, i: int, j: int) -> float:
    a, b = (dataset.scenes[scene].views[k] for k in (i, j))

    def depth(image: ImageSource, x: float, y: float) -> float:
        return float(dataset.depth(image, np.array([[x, y]], np.float64))[0])

    shares = []
    for first, second in ((a, b), (b, a)):
        R = second.R @ first.R.T
        depths = (functools.partial(depth, view.image) for view in (first, second))
        sizes, limits = (first.image.size, second.image.size), (construction.STEP, construction.TOLERANCE)
        shares.append(reference.share(*depths, first.K, second.K, sizes, R, second.t - R @ first.t, *limits))
    return min(shares)


def test_overlap_of_rendered_pairs_is_that_counted_pixel_by_pixel(rendered: ScenePairs) -> None:
    overlaps = construction.overlap_of(rendered)
    assert isinstance(overlaps, construction.DepthOverlap)
    places = [rendered.candidate(rank) for rank in range(rendered.candidates)]
    assert len(places) == 2 * 6
    shares = [overlaps.of(place) for place in places]
    assert shares[::4] == [one_by_one(rendered, *place) for place in places[::4]]
    assert min(shares) < 0.4 < 0.6 < max(shares)


def test_the_command_selects_by_overlap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neighbours share four of five points, the first and the last image, which is number 1 by name, three of five."""
    write_colmap(tmp_path / "Set/a")
    run(tmp_path, monkeypatch, *COLMAP, "overlap=[0.7,0.9]")
    selected = load("fmbench", root=tmp_path / "Made")
    assert [pair.identity for pair in selected] == ["Made/a/0-2", "Made/a/1-2"]
    rule = json.loads((tmp_path / "Made/pairs.json").read_text())["rule"]
    assert rule == {"overlap": [0.7, 0.9], "by": "points"}
    with pytest.raises(SystemExit, match=r"holds pairs of other settings; .*: rule\.overlap: .*Name another folder"):
        run(tmp_path, monkeypatch, *COLMAP, "overlap=[0.6,0.9]")
    run(tmp_path, monkeypatch, *COLMAP, "overlap=[0.6,0.6]", "output=Other")
    assert [pair.identity for pair in load("fmbench", root=tmp_path / "Other")] == ["Other/a/0-1"]
    (tmp_path / "Set/a/images/00.png").write_text("no image")  # which loses its own pairs
    run(tmp_path, monkeypatch, *COLMAP, "overlap=[0.1,1]", "output=Third")
    assert [pair.identity for pair in load("fmbench", root=tmp_path / "Third")] == ["Third/a/1-2"]


@pytest.mark.parametrize("n", [0, 1, 2, 7])
def test_all_pairs_are_all_combinations_in_order(n: int) -> None:
    pairs = AllPairs(n)
    expected = list(itertools.combinations(range(n), 2))
    assert len(pairs) == len(expected)
    assert [tuple(p) for p in pairs.at(np.arange(len(pairs)))] == expected


def test_all_pairs_of_a_million_images_are_not_listed() -> None:
    pairs = AllPairs(1_000_000)
    assert len(pairs) == 499_999_500_000
    assert pairs.at(np.array([0, 999_999, len(pairs) - 1])).tolist() == [[0, 1], [1, 2], [999_998, 999_999]]
    ranks = np.asarray(drawn(len(pairs), 1000, seed=0))
    assert len(set(ranks.tolist())) == 1000
    assert (np.diff(pairs.at(ranks)) > 0).all()


@pytest.mark.parametrize("window", [0.0, 0.35, 100.0])
def test_following_frames_are_those_within_the_window(window: float) -> None:
    times = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.2, 60))
    expected = [(i, j) for i, j in itertools.combinations(range(60), 2) if times[j] - times[i] <= window]
    pairs = following(times, window)
    assert [tuple(p) for p in pairs.at(np.arange(len(pairs)))] == expected


def test_points_that_images_share_are_those_counted_one_by_one() -> None:
    rng = np.random.default_rng(1)
    points = [rng.integers(0, 60, rng.integers(0, 40)) for _ in range(40)]
    points[4], points[7] = rng.integers(0, 2**40, 3).repeat(2), np.zeros(0, np.int64)
    pairs, seen = np.array(list(itertools.combinations(range(40), 2))), incidence(points)
    shares = [reference.by_points(points[i].tolist(), points[j].tolist()) for i, j in pairs]
    np.testing.assert_allclose(construction.shared_points(seen, pairs), shares, rtol=0, atol=1e-15)
    assert len(construction.shared_points(seen, pairs[:0])) == 0
    counts = np.array([len({*points[i].tolist()} & {*points[j].tolist()}) for i, j in pairs])
    for minimum in (1, 5):
        np.testing.assert_array_equal(sharing_points(points, minimum).pairs, pairs[counts >= minimum])
        assert 50 < (counts >= minimum).sum() < len(pairs)
    assert len(sharing_points([])) == 0


def test_the_splits_are_the_papers_and_share_no_sequence() -> None:
    assert SPLITS["kitti"] == {"test": ("06", "07", "08", "09", "10"), "train": ("00", "01", "02", "03", "04", "05")}
    short = [name.removeprefix("rgbd_dataset_freiburg3_") for name in SPLITS["tum"]["test"]]
    assert short == ["teddy", "large_cabinet", "long_office_household"]
    for name in SPLITS:
        train, test = (set(chosen(name, split, None, THERE)) for split in ("train", "test"))
        assert (bool(train), bool(test), train & test) == (True, True, set())
        assert chosen(name, "test", ["other"], THERE) == ["other"]
    assert chosen("tum", "train", None, THERE) == ["06", "Horse", "Train", "rgbd_dataset_freiburg1_xyz"]
    for name, split, sequences in (("tum", "train", None), ("kitti", "test", [])):
        with pytest.raises(DataError, match=f"{name}: no sequence in split '{split}'"):
            chosen(name, split, sequences, [])


@pytest.mark.parametrize("name", presets.available("dataset"))
def test_the_preset_has_every_option_with_the_readers_default(name: str) -> None:
    preset = presets.load("dataset", name)
    parameters = inspect.signature(presets.target_of(preset, "dataset")).parameters
    defaults = {key: p.default for key, p in parameters.items() if p.kind is not p.KEYWORD_ONLY}
    assert {key: value for key, value in preset.items() if key != "_target_"} == defaults
