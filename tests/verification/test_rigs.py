"""Databases of rigs: what COLMAP stores of cameras, frames, keypoints and matches stays as it is."""

import sqlite3
from pathlib import Path
from typing import Any

import pycolmap
import pytest

import fmtorch


def rows(path: Path) -> dict[str, list[Any]]:
    """The contents of all tables but that of geometries."""
    with sqlite3.connect(path) as connection:
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        kept = sorted(name for name in names if name != "two_view_geometries")
        return {name: sorted(connection.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in kept}


@pytest.mark.parametrize("copied", [False, True])
def test_rigs_and_frames_stay_as_they_are(copied: bool, tmp_path: Path) -> None:
    """Two rigs of two cameras each, moved to three places."""
    path, copy = tmp_path / "database.db", tmp_path / "verified.db"
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=3)
    with pycolmap.Database.open(path) as database:
        pycolmap.synthesize_dataset(options, database)
        database.clear_two_view_geometries()
        assert (database.num_rigs(), database.num_frames(), database.num_images()) == (2, 6, 12)
    before = rows(path)
    assert len(before["rig_sensors"]) == 2  # one camera of each rig is its reference
    assert len(before["frame_data"]) == 12
    result = fmtorch.verify(path, output=copy if copied else None)
    assert result.problems == ()
    assert result.verified > 30
    assert rows(copy if copied else path) == before
    assert rows(path) == before
