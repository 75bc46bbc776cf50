"""What the benchmark of verified databases measures, that it goes on, and models of known cameras."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from scripts.benchmark import verify
from scripts.benchmark.runner import Kept
from scripts.benchmark.verify import Scene, Truth, accuracy, calibrate, centre_errors, sheets
from tests.verification import databases

K = np.array([[700.0, 0, 310], [0, 701, 250], [0, 0, 1]])
AREAS = [f"{name}{limit}" for name in ("auc", "centre") for limit in (1, 5, 10)]


def scene(count: int = 5) -> tuple[Scene, dict[str, Any]]:
    """Cameras, and their poses in a frame that is turned, moved and twice as large."""
    cameras = databases.scene(count)
    names = [f"{i:03d}.jpg" for i in range(count)]
    truth = Truth(*(dict(zip(names, values, strict=True)) for values in ([K] * count, cameras.R, cameras.t)))
    turn = databases.scene(2).R[1]
    poses = {}
    for name in names:
        centre = 2 * turn @ (-truth.R[name].T @ truth.t[name]) + np.array([1.0, 2, 3])
        R = truth.R[name] @ turn.T
        poses[name] = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ centre)
    return Scene("walk", Path(), truth, True), poses


def test_true_poses_have_no_error_in_any_frame_and_an_image_without_a_pose_counts_as_wrong() -> None:
    """Without one, four of the ten pairs, and one of the five centres."""
    walk, poses = scene()
    figures = accuracy(poses, walk.truth)
    assert set(figures) == set(AREAS)
    assert min(figures.values()) > 99.99
    assert centre_errors(poses, walk.truth).max() < 1e-6
    del poses["002.jpg"]
    figures = accuracy(poses, walk.truth)
    assert figures["auc10"] == pytest.approx(60, abs=0.01)
    assert figures["centre10"] == pytest.approx(80, abs=0.01)
    assert accuracy({}, walk.truth)["centre10"] == 0


def test_known_cameras_are_the_true_ones(tmp_path: Path) -> None:
    """In COLMAP's pixels, and with a prior."""
    path = tmp_path / "database.db"
    databases.write(path, databases.scene(5), prior=False)
    calibrate(path, scene()[0].truth)
    with pycolmap.Database.open(path) as database:
        (camera,) = database.read_all_cameras()
    assert (camera.model_name, camera.has_prior_focal_length) == ("PINHOLE", True)
    assert camera.params.tolist() == [700, 701, 310.5, 250.5]


def test_an_interrupted_run_measures_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    databases.write(tmp_path / "walk.db", databases.scene(3))
    mapped: list[str] = []

    def interrupted(mapper: str, *_: Any) -> dict[str, Any]:
        mapped.append(mapper)
        if len(mapped) == 2:
            raise KeyboardInterrupt
        return {"seconds": 1.0, "registered": 3, "images": 3, **dict.fromkeys(AREAS, 50.0)}

    monkeypatch.setattr(verify, "mapped", interrupted)
    key = ("walk", "colmap", "known", "ours", 0)
    walk = scene(3)[0]
    for _ in range(2):
        kept = Kept(tmp_path / "rows.jsonl")
        try:
            verify.measure(walk, tmp_path / "walk.db", key, ["incremental", "global"], kept)
        except KeyboardInterrupt:
            assert [row["mapper"] for row in kept.rows] == ["", "incremental"]
    assert mapped == ["incremental", "global", "global"]
    assert [row["mapper"] for row in kept.rows] == ["", "incremental", "global"]
    assert (kept.rows[0]["pairs"], kept.rows[0]["verified"], kept.rows[0]["poses"]) == (3, 3, 3)
    assert [path.name for path in tmp_path.glob("*.db*")] == ["walk.db"]
    means, pairs, models = ([list(line.values()) for line in sheet.records] for sheet in sheets(kept.rows))
    assert means[0][:4] == ["colmap", "known", "ours", 1]
    assert means[0][5:9] == ["100.0", "50.0", "50.0", "50.0"]
    assert pairs[0][3:7] == ["walk", 1, "3", "3"]
    assert [line[3:7] for line in models] == [[m, "walk", 1, "3.0"] for m in ("incremental", "global")]
