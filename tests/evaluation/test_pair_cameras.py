"""Runs with cameras: what the estimator is given, poses of estimated cameras, and the identity of a run."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import ExifTags, Image

from fmtorch import presets
from fmtorch.core import collate
from fmtorch.data import ImageSource
from fmtorch.evaluation import WithPairCameras, cameras_of, evaluate
from fmtorch.pipeline import Outcome
from tests.conftest import shared_path
from tests.evaluation.test_poses import outcome


def photograph(path: Path, equivalent: int | None) -> ImageSource:
    """A picture of 60 x 40 px with a focal length in 35 mm."""
    exif = Image.Exif()
    if equivalent:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = equivalent
    Image.new("RGB", (60, 40)).save(path, exif=exif)
    return ImageSource(path.stem, path)


def test_what_each_word_gives(tmp_path: Path) -> None:
    pair = outcome(0).pair
    ends = photograph(tmp_path / "a.jpg", 36), photograph(tmp_path / "b.jpg", None)
    pair = dataclasses.replace(pair, image0=ends[0], image1=ends[1])
    known = cameras_of([pair], "known")[pair.key]
    assert torch.equal(known.K0, torch.from_numpy(pair.K0))
    assert known.focal.tolist() == [[1, 0], [1, 0]]
    exif = cameras_of([pair], "exif")[pair.key]
    assert exif.K0 is exif.K1 is None
    assert exif.focal[0].tolist() == pytest.approx([60, math.hypot(0.06, 1 / math.sqrt(12) / 36)])
    assert exif.focal[1].tolist() == [1, math.inf]
    shared, unknown = (cameras_of([pair], word)[pair.key] for word in ("shared", "unknown"))
    assert (shared.shared_focal, unknown.shared_focal) == (True, False)
    assert shared.focal[:, 1].tolist() == unknown.focal[:, 1].tolist() == [math.inf, math.inf]


def test_a_calibration_that_is_missing_is_named() -> None:
    pair = dataclasses.replace(outcome(1).pair, K1=None)
    with pytest.raises(ValueError, match="cameras=known, but the data set has no calibration of pair p1"):
        cameras_of([pair], "known")
    assert cameras_of([dataclasses.replace(pair, problem="no image")], "known") == {}


def estimated(outcomes: list[Outcome], cameras: str) -> list[Outcome]:
    """The outcomes with the estimates of a batch whose estimator is given the cameras."""
    c = collate([o.correspondences.replace(key=torch.tensor([o.pair.key])) for o in outcomes])
    estimator = WithPairCameras(presets.build("estimator", "fmtorch"), cameras_of([o.pair for o in outcomes], cameras))
    estimate = estimator(c, 0)
    return [dataclasses.replace(o, estimate=estimate[i]) for i, o in enumerate(outcomes)]


def test_rows_have_the_pose_of_the_estimate_and_neighbours_change_nothing() -> None:
    outcomes = [outcome(seed, noise=0.1) for seed in range(3)]
    rows = evaluate(estimated(outcomes, "known"))
    for row, alone in zip(rows, (evaluate(estimated([o], "known"))[0] for o in outcomes), strict=True):
        assert row.ok
        assert row.pose_reason is None
        assert row.rotation_error < 0.5
        assert row.translation_error < 5
        assert (alone.rotation_error, alone.translation_error) == (row.rotation_error, row.translation_error)


def test_poses_that_are_not_determined_and_pairs_without_estimates_among_others() -> None:
    (posed,) = estimated([outcome(0, noise=0.1)], "known")
    nothing = torch.full((1, 3, 3), torch.nan, dtype=torch.float64)
    lost = dataclasses.replace(posed, estimate=posed.estimate.replace(R=nothing, t=nothing[:, 0]))
    rows = evaluate([lost, posed, outcome(1)])
    assert (rows[0].rotation_error, rows[0].translation_error) == (180, 90)
    assert [row.pose_reason for row in rows] == ["the pose is not determined", None, None]
    assert rows[1].rotation_error < 0.5


def test_a_run_with_cameras_is_another_run(command: Callable[..., str], tmp_path: Path) -> None:
    words = ["eval", "pipeline=sift_fmtorch", "dataset=fmbench", f"dataset.root={shared_path('data/Strecha_train')}"]
    words += ["limit=2", "workers=1"]

    def run(name: str, *more: str) -> tuple[str, dict[str, Any], dict[str, Any]]:
        said = command(*words, *more, f"output={name}", cwd=tmp_path)
        run, summary = (json.loads((tmp_path / name / f"{file}.json").read_text()) for file in ("run", "summary"))
        return said, run["config"], summary["all"]["pose"]

    assert "cameras" not in run("without")[1]
    _, identity, pose = run("known", "cameras=known")
    assert identity["cameras"] == "known"
    assert max(pose["rotation"], pose["translation"]) < 0.5
    said, identity, pose = run("signed", "cameras=known", "pose.signed=true")
    assert identity["pose"] == {"signed": True}
    assert pose["signed"] is True
    for text in (said, (tmp_path / "signed" / "summary.md").read_text()):
        spoken = " ".join(text.split())
        assert "t error, signed" in spoken
        assert "whose sign counts" in spoken
    assert "ended: error: pose.signed=2; it must be true or false" in command(*words, "pose.signed=2", cwd=tmp_path)
    assert "holds another run" in command(*words, "cameras=shared", "output=known", cwd=tmp_path)
    assert "ended: error: cameras=some" in command(*words, "cameras=some", cwd=tmp_path)
