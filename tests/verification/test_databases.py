"""Databases of COLMAP verified: the geometry is that of the public functions, and nothing is lost on the way."""

import contextlib
import functools
import os
import re
import shutil
import sqlite3
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

import fmtorch
from fmtorch.core import pair_key
from fmtorch.data import MODELS
from fmtorch.io import EXIF_DEVIATION, MatchDatabase, database_image
from tests.reference.known_cameras import angle
from tests.verification import databases
from tests.verification.databases import SIZE, killed_and_continued, plain, read, scene, write

Configuration = pycolmap.TwoViewGeometryConfiguration
BACK = np.array([[1.0, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "database.db"


def off(geometry: Any, cameras: databases.Scene, i: int = 0, j: int = 1) -> tuple[float, float]:
    """Degrees between the rotation of a geometry and the true one, and between the directions of translation."""
    (R, t), pose = cameras.relative(i, j), geometry.cam2_from_cam1
    return angle(pose.rotation.matrix(), R), float(np.degrees(np.arccos(np.clip(pose.translation @ t, -1, 1))))


def keypoints(path: Path, *images: int) -> list[np.ndarray]:
    with pycolmap.Database.open(path) as database:
        return [np.c_[database.read_keypoints(i)[:, :2], np.ones(150)] for i in images]


K = np.array([[600.0, 0, 309.5], [0, 612, 249.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("cameras", "lens"), [("stored", None), ("shared", None), ("unknown", None), ("unknown", -0.02)]
)
def test_geometries_are_those_of_find_fundamental(cameras, lens, path):
    write(path, scene(3))
    result = fmtorch.verify(path, cameras=cameras, lens=lens)
    known: dict[str, Any] = {"K0": K, "K1": K} if cameras == "stored" else {"focal": cameras, "lens": lens}
    kind = "calibrated" if cameras == "stored" else "uncalibrated"
    assert (result.pairs, result.kept, result.configurations, result.problems) == (3, 0, {kind: 3}, ())
    for pair, geometry in read(path).items():
        with pycolmap.Database.open(path) as database:
            matches = database.read_matches(*pair).astype(int)
            points = (database.read_keypoints(i)[:, :2] - np.float32(0.5) for i in pair)
            key = pair_key(" ".join(database.read_image(i).name for i in pair))
            x0, x1 = (x[indices] for x, indices in zip(points, matches.T, strict=True))
        estimate = fmtorch.find_fundamental(x0, x1, key=key, size0=SIZE, size1=SIZE, **known)
        np.testing.assert_array_equal(geometry.F, BACK.T @ estimate.F[0].double().numpy() @ BACK)
        np.testing.assert_array_equal(geometry.inlier_matches, matches[estimate.inliers[0].numpy()])
        assert geometry.config == Configuration.__members__[kind.upper()]
        R, t = geometry.cam2_from_cam1.rotation.matrix(), geometry.cam2_from_cam1.translation
        np.testing.assert_allclose(R, estimate.R[0], atol=1e-12)  # by way of a quaternion
        np.testing.assert_array_equal(t, estimate.t[0])


def test_calibrated_poses_are_the_true_ones(path: Path) -> None:
    """With E that has them, and F that vanishes at COLMAP's own pixels."""
    cameras = scene(3)
    ids = write(path, cameras, noise=0.0)
    fmtorch.verify(path)
    for (first, second), geometry in read(path).items():
        rotation, translation = off(geometry, cameras, ids.index(first), ids.index(second))
        assert rotation < 0.01
        assert translation < 0.05
        x0, x1 = keypoints(path, first, second)
        good = geometry.inlier_matches[geometry.inlier_matches[:, 0] == geometry.inlier_matches[:, 1]]
        lines = x0[good[:, 0]] @ geometry.F.T
        distance = np.abs((x1[good[:, 1]] * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
        assert distance.max() < 0.01
        colmaps = np.linalg.inv(BACK) @ K
        E = colmaps.T @ geometry.F @ colmaps
        np.testing.assert_allclose(E / np.linalg.norm(E), geometry.E * np.sign((E * geometry.E).sum()), atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_points_are_undistorted_by_every_lens(model: str, path: Path) -> None:
    cameras = scene(2)
    write(path, cameras, model, noise=0.05)
    assert fmtorch.verify(path).configurations == {"calibrated": 1}
    (geometry,) = read(path).values()
    rotation, translation = off(geometry, cameras)
    assert rotation < 0.2
    assert translation < 2
    right = np.arange(150) % 5 != 0
    assert set(np.flatnonzero(right)) <= set(geometry.inlier_matches[:, 0].tolist())


@pytest.mark.parametrize("columns", [4, 6])
def test_scales_and_shapes_of_keypoints_change_nothing(columns: int, tmp_path: Path) -> None:
    path, points = tmp_path / "frames.db", tmp_path / "points.db"
    ids = write(path, scene(2), columns=columns)
    shutil.copy(path, points)
    with pycolmap.Database.open(points) as database:
        for image in ids:
            database.update_keypoints(image, np.ascontiguousarray(database.read_keypoints(image)[:, :2]))
    for each in (path, points):
        fmtorch.verify(each)
    assert plain(read(path)) == plain(read(points))


def test_what_a_camera_is_known_for() -> None:
    """A calibration exactly, a focal length of EXIF within 5 %, COLMAP's guess not at all."""
    keypoints = np.zeros((1, 2), np.float32)
    radial, pinhole = "SIMPLE_RADIAL", "PINHOLE"
    for model, params, deviation in (
        (radial, (768, 320, 240, 0), np.inf),
        (radial, (700, 320, 240, 0), EXIF_DEVIATION),
        (radial, (700, 320, 240, 0.1), 0.0),
        (pinhole, (700, 701, 320, 240), 0.0),
        (pinhole, (700, 700, 321, 240), 0.0),
    ):
        camera = pycolmap.Camera(model=model, width=640, height=480, params=params)
        camera.has_prior_focal_length = deviation < np.inf
        assert database_image("a", camera, keypoints).deviation == deviation, (model, params)
    with pytest.raises(ValueError, match="the keypoints of a have 3 columns; they must have 2, 4 or 6"):
        database_image("a", camera, np.zeros((3, 3), np.float32))


@pytest.mark.parametrize(("kind", "name"), [("planar", "planar"), ("rotation", "panoramic")])
def test_configurations_of_special_pairs(kind: str, name: str, path: Path) -> None:
    cameras = scene(2, kind=kind)
    write(path, cameras)
    assert fmtorch.verify(path).configurations == {name: 1}
    (geometry,) = read(path).values()
    assert geometry.config == Configuration.__members__[name.upper()]
    assert len(geometry.inlier_matches) >= 115
    rotation, translation = off(geometry, cameras)
    assert rotation < (1 if kind == "planar" else 0.5)
    if kind == "rotation":
        assert not geometry.cam2_from_cam1.translation.any()
        x0, x1 = keypoints(path, 1, 2)
        there = x0[1] @ geometry.H.T
        np.testing.assert_allclose(there[:2] / there[2], x1[1, :2], atol=2)  # px
    else:
        assert translation < 5


def test_poses_of_planes(tmp_path: Path) -> None:
    """Errors of the rotation at 0.3 px: of sixty planes the quartiles are 0.16, 0.28 and 0.36 degrees, all below 1."""
    errors = []
    for seed in range(5):
        cameras, path = scene(2, seed=seed, kind="planar"), tmp_path / f"{seed}.db"
        write(path, cameras)
        fmtorch.verify(path)
        errors.append(off(*read(path).values(), cameras)[0])
    assert np.median(errors) < 0.4


def test_one_photograph_twice_and_two_of_different_places(path: Path) -> None:
    cameras = scene(2)
    cameras.R[1], cameras.t[1] = cameras.R[0], cameras.t[0]
    write(path, cameras)
    assert fmtorch.verify(path).configurations == {"planar_or_panoramic": 1}
    rng = np.random.default_rng(0)
    with pycolmap.Database.open(path) as database:
        database.update_keypoints(2, rng.uniform(0, 480, (150, 2)).astype(np.float32))
    result = fmtorch.verify(path, force=True)
    assert (result.configurations, result.verified) == ({"degenerate": 1}, 0)
    (geometry,) = read(path).values()
    assert geometry.config == Configuration.DEGENERATE
    assert not len(geometry.inlier_matches)
    assert geometry.F is None


def test_geometries_are_kept_unless_forced(path: Path, tmp_path: Path) -> None:
    write(path, scene(3))
    marked = pycolmap.TwoViewGeometry()
    marked.config = Configuration.WATERMARK
    with pycolmap.Database.open(path) as database:
        database.write_two_view_geometry(1, 3, marked)
    result = fmtorch.verify(path)
    assert (result.pairs, result.kept, result.verified) == (3, 1, 2)
    first = read(path)
    assert (first[1, 3].config, fmtorch.verify(path).kept) == (Configuration.WATERMARK, 3)
    assert plain(read(path)) == plain(first)
    result = fmtorch.verify(path, force=True)
    assert (result.kept, result.configurations) == (0, {"calibrated": 3})
    forced = read(path)
    assert forced[1, 3].config == Configuration.CALIBRATED
    assert (plain(forced)[1, 2], os.listdir(tmp_path)) == (plain(first)[1, 2], ["database.db"])


def test_a_copy_leaves_the_database_as_it_is(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "verified.db"
    write(path, scene(3))
    before = path.read_bytes()
    result = fmtorch.verify(path, output=copy)
    assert (result.path, result.verified, path.read_bytes() == before) == (copy, 3, True)
    assert (len(read(copy)), fmtorch.verify(path, output=copy).kept) == (3, 3)
    with pycolmap.Database.open(copy) as database:
        database.delete_two_view_geometry(1, 2)
    with pytest.raises(ValueError, match=re.escape(f"output={copy} exists; name another file, or replace it")):
        fmtorch.verify(path, output=copy)
    with pytest.raises(ValueError, match="is the database itself"):
        fmtorch.verify(path, output=path, force=True)
    with pytest.raises(ValueError, match=r"v\.npz must be a database, such as v\.db"):
        fmtorch.verify(path, output=tmp_path / "v.npz")
    copy.write_bytes(b"anything")
    assert fmtorch.verify(path, output=copy, force=True).verified == 3
    assert sorted(os.listdir(tmp_path)) == ["database.db", "verified.db"]


def test_a_copy_has_what_another_process_wrote_last(path: Path, tmp_path: Path) -> None:
    """And which SQLite keeps in a file of its own until that process ends."""
    copy = tmp_path / "verified.db"
    write(path, scene(3), pairs=[(0, 1)])
    with pycolmap.Database.open(path) as database:
        database.write_matches(1, 3, database.read_matches(1, 2))
        assert path.with_name("database.db-wal").exists()
        assert fmtorch.verify(path, output=copy).pairs == 2


def test_a_copy_is_whole_while_somebody_reads_it(path: Path, tmp_path: Path) -> None:
    """SQLite then leaves what was written last in a file of its own."""
    copy = tmp_path / "verified.db"
    write(path, scene(3))
    readers: list[sqlite3.Connection] = []

    def read_once(done: int, total: int) -> None:
        if not readers:
            readers.append(sqlite3.connect(tmp_path / "verified.db.partial"))
            readers[0].execute("SELECT COUNT(*) FROM matches").fetchone()

    fmtorch.verify(path, output=copy, report=read_once)
    readers[0].close()
    assert len(read(copy)) == 3
    assert sorted(os.listdir(tmp_path)) == ["database.db", "verified.db"]


def test_broken_pairs_are_lines_with_reasons(path: Path) -> None:
    write(path, scene(6), pairs=[(0, 1), (0, 2), (1, 3), (0, 4), (1, 2), (0, 5)], shared=False)
    sql(path, "DELETE FROM keypoints WHERE image_id = 3")
    sql(path, "UPDATE cameras SET model = 17, params = ? WHERE camera_id = 5", np.array([640.0, 320.0]).tobytes())
    opencv = np.array([600.0, 600, 320, 240, 1e6, 0, 0, 0]).tobytes()
    sql(path, "UPDATE cameras SET model = 4, params = ? WHERE camera_id = 6", opencv)
    with pycolmap.Database.open(path) as database:
        database.update_keypoints(4, np.zeros((7, 2), np.float32))
    result = fmtorch.verify(path)
    assert (result.pairs, result.verified) == (6, 1)
    assert sorted(result.problems)[:4] == [
        "000.jpg, 002.jpg: 002.jpg has no keypoints",
        "000.jpg, 004.jpg: camera 5 of 004.jpg is EQUIRECTANGULAR, which is no pinhole behind a lens",
        "000.jpg, 005.jpg: camera 6 of 005.jpg: its lens folds the image or shrinks it to a point "
        "(k1 k2 p1 p2 = 1e+06 0 0 0); calibrate it again",
        "001.jpg, 002.jpg: 002.jpg has no keypoints",
    ]
    assert "001.jpg, 003.jpg: a match is of keypoint 149, 003.jpg has 7 of them" in result.problems
    assert (list(read(path)), fmtorch.verify(path).kept) == ([(1, 2)], 1)


def sql(path: Path, statement: str, *values: object) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute(statement, values)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda p: p.unlink(), "there is no file {}; give the database of a COLMAP project: database.db"),
        (lambda p: p.write_text("matches\n" * 20), "{} is not a COLMAP database; give the database.db"),
        (lambda p: (p.unlink(), p.mkdir()), "{} is a folder; give the database file in it: {}/database.db"),
        (lambda p: sql(p, "PRAGMA user_version = 99000000"), "{} was written by a newer COLMAP"),
        (lambda p: (p.unlink(), sql(p, "CREATE TABLE songs (a)")), "{} is a database, but none of COLMAP's: it"),
        (lambda p: sql(p, "DELETE FROM matches"), "{} holds no matches; match the images (colmap exhaus"),
        (lambda p: sql(p, "DELETE FROM keypoints"), "{} holds no keypoints; extract features (colmap f"),
        (lambda p: os.truncate(p, 5000), "{} cannot be read as a COLMAP database: "),
    ],
)
def test_what_is_no_database_to_verify(damage: Any, said: str, path: Path) -> None:
    write(path, scene(2))
    damage(path)
    with pytest.raises((ValueError, FileNotFoundError), match="^" + re.escape(said.format(path, path))):
        fmtorch.verify(path)


def test_a_database_that_is_being_written_to(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(path, scene(2))
    monkeypatch.setattr(sqlite3, "connect", functools.partial(sqlite3.connect, timeout=0.1))
    with contextlib.closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(OSError, match=re.escape(f"{path} cannot be written: ")):
            fmtorch.verify(path)
    assert fmtorch.verify(path).verified == 1


def test_wrong_arguments(path: Path) -> None:
    write(path, scene(2))
    for name, value, said in (
        ("cameras", "known", "cameras is 'known'; it must be one of stored, shared, unknown"),
        ("estimator", "homography", "gives homography matrices; verify needs one that gives fundamental"),
        ("estimator", "ransack", "no preset 'ransack' in conf/estimator"),
        ("output", path.parent / "no" / "copy.db", "there is no folder"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=said):
            fmtorch.verify(path, **{name: value})
    assert read(path) == {}


def test_a_database_of_colmap_3(path: Path) -> None:
    """Without rigs and frames, which pycolmap adds when it opens one."""
    write(path, scene(3))
    for table in ("frame_data", "frames", "rig_sensors", "rigs", "two_view_geometries"):
        sql(path, f"DROP TABLE {table}")
    columns = "pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB"
    sql(path, f"CREATE TABLE two_view_geometries ({columns}, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB)")
    sql(path, "PRAGMA user_version = 3600")
    assert fmtorch.verify(path).configurations == {"calibrated": 3}
    assert all(geometry.cam2_from_cam1 is not None for geometry in read(path).values())


def test_keypoints_are_read_for_many_images_in_blocks(path, tmp_path, monkeypatch):
    other = tmp_path / "other.db"
    write(path, scene(6))
    write(other, scene(6))
    fmtorch.verify(path)
    monkeypatch.setattr("fmtorch.verification.verify.BATCH", 2)
    monkeypatch.setattr("fmtorch.io.colmap.BLOCK", 2)
    monkeypatch.setattr("fmtorch.io.colmap.MEMORY", 3)
    with MatchDatabase(other) as database:
        pairs = database.pairs()
    assert pairs[5:12] == [(2, 3), (2, 4), (2, 5), (3, 4), (3, 5), (2, 6), (3, 6)]
    fmtorch.verify(other)
    assert plain(read(other)) == plain(read(path))


@pytest.mark.parametrize("way", ["in place", "copy", "forced", "forced copy"])
def test_a_killed_verification_continues(way: str, tmp_path: Path) -> None:
    """kill -9 after some batches: the database can be read, and the same command ends with the same geometries."""
    source, truth = tmp_path / "database.db", tmp_path / "truth.db"
    write(source, scene(6))
    fmtorch.verify(source, output=truth)
    extra = {"in place": [], "copy": ["output=copy.db"], "forced": ["force=true"]}
    arguments = extra.get(way, ["output=copy.db", "force=true"])
    if "forced" in way:
        old = pycolmap.TwoViewGeometry()
        old.config = Configuration.WATERMARK
        with pycolmap.Database.open(source) as database:
            for pair in read(truth):
                database.write_two_view_geometry(*pair, old)
    end = tmp_path / ("copy.db" if "copy" in way else "database.db")
    killed_and_continued(tmp_path, end, "database.db", *arguments)
    assert plain(read(end)) == plain(read(truth))


def test_the_command_and_without_pycolmap_an_extra_that_it_needs(command, tmp_path, monkeypatch):
    write(tmp_path / "database.db", scene(3))
    said = command("verify", "database.db", "output=copy.db", "cameras=shared", "estimator=msac", cwd=tmp_path)
    assert re.search(r"verified\W+3\W", said)
    assert "uncalibrated" in said
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    said = command("verify", "database.db", cwd=tmp_path)
    assert said == "ended: error: pycolmap is not installed; pip install 'fmtorch[colmap]' brings it"


@pytest.mark.parametrize("focal", [1500.0, 10.0, 0.0, -600.0, 1e10, np.inf])
def test_a_focal_length_that_matches_contradict_or_that_is_absurd_is_no_calibration(focal: float, path: Path) -> None:
    """1500: EXIF of another lens. The pose is that of the focal length that the matches show."""
    cameras = scene(2, count=400)
    write(path, cameras, "SIMPLE_PINHOLE", noise=0.1)
    assert fmtorch.verify(path).configurations == {"calibrated": 1}
    with pycolmap.Database.open(path) as database:
        camera = database.read_camera(1)
        camera.params = [focal, 320, 240]
        database.update_camera(camera)
    result = fmtorch.verify(path, force=True)
    assert (result.configurations, result.problems) == ({"uncalibrated": 1}, ())
    absurd = f"a focal length of {focal:g} px for 640 x 480 pixels counts as unknown"
    assert any(absurd in line for line in result.warnings) == (focal != 1500), result.warnings
    assert off(*read(path).values(), cameras)[0] < 1


def test_a_crop_of_a_database_is_calibrated(path: Path) -> None:
    cameras = scene(2, count=400)
    cameras.X[:, 0] += 4
    write(path, cameras, "PINHOLE", params=[600, 600, -20, 240])
    assert fmtorch.verify(path).configurations == {"calibrated": 1}
    assert off(*read(path).values(), cameras)[0] < 0.5


def rows(path: Path) -> dict[str, list[Any]]:
    """The contents of all tables but that of geometries."""
    with sqlite3.connect(path) as connection:
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        kept = sorted(name for name in names if name != "two_view_geometries")
        return {name: sorted(connection.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in kept}


@pytest.mark.parametrize("copied", [False, True])
def test_rigs_and_frames_stay_as_they_are(copied: bool, path: Path, tmp_path: Path) -> None:
    """Two rigs of two cameras each, moved to two places."""
    copy = tmp_path / "verified.db"
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=2)
    with pycolmap.Database.open(path) as database:
        pycolmap.synthesize_dataset(options, database)
        database.clear_two_view_geometries()
        assert (database.num_rigs(), database.num_frames(), database.num_images()) == (2, 4, 8)
    before = rows(path)
    assert len(before["rig_sensors"]) == 2  # one camera of each rig is its reference
    assert len(before["frame_data"]) == 8
    result = fmtorch.verify(path, output=copy if copied else None)
    assert result.problems == ()
    assert result.verified > 12
    assert (rows(copy if copied else path), rows(path)) == (before, before)
