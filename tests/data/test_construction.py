"""Pairs by the paper's rule, as a set in the FM-Bench layout: on real scenes, on made ones, and interrupted."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.data import construction as rule
from fmtorch.data import load, read_image, to_grey
from fmtorch.data.construction import Construction, blocks
from tests.conftest import shared_path
from tests.data.native import write_image
from tests.helpers import apart, call_command

"""The column `selected` of the README of the shared data, for the scenes of which all pairs were candidates."""


def test_kept_pairs_of_a_real_scene_are_selected_again() -> None:
    root = shared_path("data/PhotoTourism/sacre_coeur")
    dataset = load("cameras", root=root.parent, sequences=[root.name], pairs=None)
    features = {i: rule.keypoints(to_grey(read_image(root / f"Images/{i:08d}.jpg"))) for i in range(4)}
    passed = set()
    for pair in dataset:
        i, j = map(int, pair.identity.rpartition("/")[2].split("-"))
        if j < 4 and rule.matchable(features[i], features[j], pair.F):
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
    pictures = [
        cv2.resize(read_image(source), None, fx=0.5, fy=0.5)[..., ::-1] for source in (pair.image0, pair.image1)
    ]
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


def test_the_command_makes_a_set_of_the_pairs_that_can_be_matched(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_a_finished_set_is_not_made_again_and_another_is_refused(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "Made").mkdir()
    (tmp_path / "Made/notes.txt").write_text("mine")
    with pytest.raises(SystemExit, match=r"error: Made is not empty and has no pairs\.json, .*; name another folder"):
        run(tmp_path, monkeypatch, "count=1")
    (tmp_path / "Made/notes.txt").unlink()
    run(tmp_path, monkeypatch, "count=1")
    before = (tmp_path / "Made/pairs_with_gt.txt").stat().st_mtime_ns
    monkeypatch.setattr(rule, "keypoints", None)  # nothing is judged again
    run(tmp_path, monkeypatch, "count=1")
    assert "Made is complete" in capsys.readouterr().out
    assert (tmp_path / "Made/pairs_with_gt.txt").stat().st_mtime_ns == before
    with pytest.raises(SystemExit, match=r"Made holds pairs of other settings; .*: count: 1 -> 2\. Name another"):
        run(tmp_path, monkeypatch, "count=2")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["output=null"], "output is missing; it names the folder of the set that is made"),
        (["count=0"], "count=0; it must be a whole number of at least 1 or null"),
        (["quality=101"], "quality=101; it must be a whole number from 1 to 100"),
        (
            ["dataset=stereo", "dataset.root=null"],
            "dataset=stereo has no candidates to judge; it must be one of tum, kitti, colmap",
        ),
        (["dataset=fmbench", "dataset.root=null"], "fmbench needs root"),
        (["dataset=kitti"], "no such folder; it must hold a folder for each sequence"),
        (["dataset.fps=0"], "fps=0; it must be positive, or null for images in no order"),
        (["dataset.root=empty"], "no folder with Camera.txt, one line an image: K"),
    ],
)
def test_a_mistake_is_told_in_one_line_and_nothing_written(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match=r"^error: ") as end:
        run(tmp_path, monkeypatch, *words)
    assert message in str(end.value.code)
    assert "\n" not in str(end.value.code)
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_a_draw_is_the_same_however_it_is_interrupted(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of one candidate each; the first try ends after nine of them, whose verdicts are not asked for again."""
    monkeypatch.setattr("fmtorch.data.construction.BLOCK", 1)
    dataset = load("cameras", root=scenes)
    uninterrupted = Construction(dataset, tmp_path / "Whole", count=3, seed=5)  # type: ignore[arg-type]
    broken = Construction(dataset, tmp_path / "Made", count=3, seed=5)  # type: ignore[arg-type]
    assert sorted(uninterrupted.order().tolist()) == list(range(20))
    uninterrupted.begin()
    passed = [
        rank
        for number, ranks in blocks(uninterrupted.order())
        for rank in ranks
        if uninterrupted.judge(number, ranks).kept[0]
    ]
    assert len(passed) == 4
    broken.begin()
    for number, ranks in list(blocks(broken.order()))[:9]:
        broken.judge(number, ranks)
    asked, matchable = list[object](), rule.matchable
    monkeypatch.setattr(rule, "matchable", lambda *given: asked.append(given) or matchable(*given))
    run(tmp_path, monkeypatch, "count=3", "seed=5", "workers=1")
    last = uninterrupted.order().tolist().index(passed[2])
    judged = [dataset.candidate(rank) for rank in uninterrupted.order()[9 : last + 1].tolist()]  # type: ignore[attr-defined]
    assert len(asked) == sum(4 not in place[1:] and place[1:] != (0, 2) for place in judged) > 0
    places = sorted(dataset.candidate(rank) for rank in passed[:3])  # type: ignore[attr-defined]
    assert [p.identity for p in load("fmbench", root=tmp_path / "Made")] == [
        f"Made/{'ab'[scene]}/{i}-{j}" for scene, i, j in places
    ]
