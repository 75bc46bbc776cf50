"""A COLMAP database of keypoints, matches and two-view geometries, written through pycolmap."""

import contextlib
import dataclasses
import functools
import math
import os
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fmtorch.core import lazy
from fmtorch.core.files import replacing
from fmtorch.core.lenses import MODELS, folded, undistortion
from fmtorch.data.files import Array, Indices, Mask, Matrix, Singles
from fmtorch.geometry.cameras import MAX_KNOWN_FOCAL, MIN_FOCAL, USUAL_FOCAL, calibration_problems
from fmtorch.io.match_store import ORIGIN, PairGeometry, StoredImage, StoredPair, two_view_geometry

FOCAL_LENGTH = 1.2  # of the longer side, where it is unknown: COLMAP's own default


def imported() -> Any:
    """pycolmap. Raises ImportError naming the extra where it is not installed."""
    return lazy.imported("pycolmap", "pycolmap is not installed; pip install 'fmtorch[colmap]' brings it")


def write_database(
    path: Path, images: Iterable[StoredImage], pairs: Iterable[StoredPair], shared_camera: bool = False
) -> None:
    """Write a database: keypoints, the matches given to the estimator, and the geometry of each pair with its inliers.
    Degenerate geometries are left out; a pair without a geometry has F, with both cameras known E, too, where its
    support is beyond chance. A known K is a PINHOLE camera with a trusted focal length, one with distortion is of its
    lens's model; images of equal cameras and size share it. Otherwise an image has a SIMPLE_RADIAL camera of the focal
    length of EXIF, or COLMAP's default, or shares it with all of its size. Pixels are moved by half, as COLMAP's."""
    pycolmap = imported()
    cameras: dict[object, int] = {}
    ids: dict[str, int] = {}
    known: dict[str, Matrix | None] = {}
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database:
        for image in images:
            camera_id = _camera(pycolmap, database, cameras, image, shared_camera)
            entry = pycolmap.Image(name=image.name, camera_id=camera_id)
            ids[image.name] = entry.image_id = database.write_image(entry)
            known[image.name] = image.K
            frame = pycolmap.Frame(rig_id=camera_id)
            frame.add_data_id(entry.data_id)
            database.write_frame(frame)
            database.write_keypoints(ids[image.name], np.ascontiguousarray(image.points + np.float32(ORIGIN)))
        for pair in pairs:
            ends = ids[pair.name0], ids[pair.name1]
            matches = _one_to_one(pair)
            database.write_matches(*ends, np.ascontiguousarray(pair.matches[matches], np.uint32))
            geometry = _geometry(pair, pair.matches[matches], known)
            if geometry.kind != "degenerate":
                database.write_two_view_geometry(*ends, two_view_geometry(pycolmap, geometry))


def _camera(pycolmap: Any, database: Any, cameras: dict[object, int], image: StoredImage, shared: bool) -> int:
    model, parameters, prior = _parameters(image)
    own = image.K is None and image.lens is None and not shared
    key: object = image.name if own else (image.size, model, *parameters)
    if key not in cameras:
        h, w = image.size
        camera = pycolmap.Camera(model=model, width=w, height=h, params=parameters)
        camera.has_prior_focal_length = prior
        camera.camera_id = cameras[key] = database.write_camera(camera)
        rig = pycolmap.Rig(rig_id=cameras[key])
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    return cameras[key]


def _parameters(image: StoredImage) -> tuple[str, list[float], bool]:
    h, w = image.size
    if (lens := image.lens) is not None:
        focals = [lens.fx] if MODELS[lens.model].focals == 1 else [lens.fx, lens.fy]
        return lens.model, [*focals, lens.cx + ORIGIN, lens.cy + ORIGIN, *lens.coefficients], True
    if (K := image.K) is not None:
        return "PINHOLE", [float(K[0, 0]), float(K[1, 1]), float(K[0, 2] + ORIGIN), float(K[1, 2] + ORIGIN)], True
    focal = FOCAL_LENGTH * max(h, w) if image.focal is None else image.focal
    return "SIMPLE_RADIAL", [focal, w / 2, h / 2, 0.0], image.focal is not None


def _geometry(pair: StoredPair, matches: Array, known: dict[str, Matrix | None]) -> PairGeometry:
    if pair.geometry is not None:
        verified = pair.geometry.inliers[among(pair.geometry.inliers, matches)]
        return pair.geometry._replace(inliers=verified.astype(np.int32).reshape(-1, 2))
    if not (pair.related and pair.F.any()):
        return PairGeometry("degenerate", matches[:0])
    index = pair.matches[pair.inliers]
    inliers = index[among(index, matches)]
    K0, K1 = known[pair.name0], known[pair.name1]
    if K0 is None or K1 is None:
        return PairGeometry("uncalibrated", inliers, pair.F)
    return PairGeometry("calibrated", inliers, pair.F, K1.T @ pair.F @ K0)


def among(rows: Array, others: Array) -> Mask:
    """Which pairs of keypoints, (n, 2), are among others."""
    known = set(map(tuple, others.tolist()))
    return np.array([tuple(row) in known for row in rows.tolist()], bool)


def _one_to_one(pair: StoredPair) -> Mask:
    """Matches that share no keypoint with a better one: COLMAP's tracks allow one each; inliers come first."""
    keep, taken0, taken1 = np.zeros(len(pair.matches), bool), set[int](), set[int]()
    inliers = pair.inliers if pair.geometry is None else among(pair.matches, pair.geometry.inliers)
    for k in np.lexsort((-pair.scores, ~inliers)):
        i, j = pair.matches[k].tolist()
        if i not in taken0 and j not in taken1:
            keep[k] = True
            taken0.add(i)
            taken1.add(j)
    return keep


EXIF_DEVIATION = 0.05  # relative, of focal lengths by EXIF (docs/cameras.md)


@dataclasses.dataclass(frozen=True)
class DatabaseImage:
    """An image with its keypoints, px, with (0, 0) at the centre of the first pixel.
    size: (h, w), and K, None where unknown. points: (n, 2) as stored; pinhole: (n, 2), where a pinhole of calibration K
    would have put them, NaN where it sees nothing. stretch: its derivatives (n, 2, 2), None where it is as stored.
    deviation: relative, of the focal length of K: 0 where it was calibrated, infinite where it is COLMAP's guess.
    problem: what is wrong with the camera. warning: what of it is not taken for known. Scales, orientations and shapes
    of keypoints are not used (docs/verify.md)."""

    name: str
    camera_id: int
    size: tuple[int, int] | None
    K: Matrix | None
    deviation: float
    points: Singles
    pinhole: Singles
    problem: str = ""
    warning: str = ""
    stretch: Singles | None = None


def database_image(name: str, camera: Any, keypoints: Singles) -> DatabaseImage:
    """The image of a `pycolmap.Camera` and its keypoints (n, 2), (n, 4) or (n, 6); raises ValueError for others."""
    size, columns = (int(camera.height), int(camera.width)), keypoints.shape[1]
    if columns not in (2, 4, 6):
        raise ValueError(f"the keypoints of {name} have {columns} columns; they must have 2, 4 or 6")
    points = keypoints[:, :2] - np.float32(ORIGIN)
    model = str(camera.model_name)
    if model not in MODELS:
        problem = f"camera {camera.camera_id} of {name} is {model}, which is no pinhole behind a lens"
        return DatabaseImage(name, camera.camera_id, size, np.eye(3), math.inf, points, points, problem)
    lens = MODELS[model].lens(model, np.asarray(camera.params, np.float64))
    K = lens.K - np.array([[0, 0, ORIGIN], [0, 0, ORIGIN], [0, 0, 0]])
    whose, warning, centre = f"camera {camera.camera_id} of {name}", "", ((size[1] - 1) / 2, (size[0] - 1) / 2)
    exif = lens.fx == lens.fy and tuple(K[:2, 2]) == centre and not any(lens.coefficients)  # nothing else is known
    deviation = (EXIF_DEVIATION if exif else 0.0) if camera.has_prior_focal_length else math.inf
    absurd = [f for f in (lens.fx, lens.fy) if not MIN_FOCAL * max(size) <= f <= MAX_KNOWN_FOCAL * max(size)]
    if absurd:
        warning = f"{whose}: a focal length of {absurd[0]:g} px for {size[1]} x {size[0]} pixels counts as unknown"
        K[0, 0] = K[1, 1] = USUAL_FOCAL * max(size)
        deviation = math.inf
    wrong = calibration_problems(torch.from_numpy(K)[None], torch.tensor([size]), "its calibration")[0]
    pinhole, stretch, pixels = points, None, np.ascontiguousarray(keypoints[:, :2], np.float64)
    if lens.bends and not (absurd or wrong) and (wrong := folded(lens, pixels)) == "":
        rays = np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2)
        pinhole = (rays @ K[:2, :2].T + K[:2, 2]).astype(np.float32)
        with np.errstate(all="ignore"):
            stretch = undistortion(lens, rays @ lens.K[:2, :2].T + lens.K[:2, 2]).astype(np.float32)
    problem = f"{whose}: {wrong}" if wrong else ""
    return DatabaseImage(name, camera.camera_id, size, K, deviation, points, pinhole, problem, warning, stretch)


MAGIC = b"SQLite format 3\0"
TABLES = {"cameras", "images", "keypoints", "matches", "two_view_geometries"}
BLOCK = 64  # images: pairs are sorted by blocks of both images, so that keypoints are read seldom
MEMORY = 2 * BLOCK + 1  # images whose keypoints are kept

Ids = tuple[int, int]


class MatchDatabase(contextlib.AbstractContextManager["MatchDatabase"]):
    """An open database. Its images are read when they are needed, and few of them are kept.
    Raises as `expect_database`, ValueError without keypoints or matches, OSError for a full disk or a held database."""

    def __init__(self, path: Path, original: Path | None = None) -> None:
        """original: of which it is a copy, and which errors name."""
        self._pycolmap = imported()
        expect_database(path)
        self._path = path
        with _naming(path):
            self._database = self._pycolmap.Database.open(path)
        self.image = functools.lru_cache(maxsize=MEMORY)(self._image)
        lacking = ""
        if not self._database.num_keypoints():
            lacking = "keypoints; extract features (colmap feature_extractor)"
        elif not self._database.num_matched_image_pairs():
            lacking = "matches; match the images (colmap exhaustive_matcher)"
        if lacking:
            self.close()
            raise ValueError(f"{original or path} holds no {lacking} first")

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        self._database.close()

    def pairs(self) -> list[Ids]:
        """The pairs of images that have matches, those of the same images near one another."""
        ids, _ = self._database.read_num_matches()
        pairs = [self._pycolmap.pair_id_to_image_pair(pair_id) for pair_id in ids]
        return sorted(pairs, key=lambda pair: (pair[0] // BLOCK, pair[1] // BLOCK, pair))

    def identity(self) -> dict[str, Any]:
        """How many keypoints and matches there are, by which a database is known again."""
        return {"keypoints": self._database.num_keypoints(), "matches": self._database.num_matches()}

    def has_geometry(self, pair: Ids) -> bool:
        return bool(self._database.exists_two_view_geometry(*pair))

    def matches(self, pair: Ids) -> Indices:
        """The matches of a pair, keypoints (n, 2) of its images.
        Raises ValueError where there are no such keypoints."""
        matches = np.asarray(self._database.read_matches(*pair)).astype(np.int64).reshape(-1, 2)
        for image_id, index in zip(pair, matches.T, strict=True):
            image = self.image(image_id)
            if len(index) and index.max() >= len(image.points):
                raise ValueError(f"a match is of keypoint {index.max()}, {image.name} has {len(image.points)} of them")
        return matches

    def write(self, geometries: Iterable[tuple[Ids, PairGeometry]]) -> None:
        """Write geometries of pairs, in place of those that they have, all of them or, killed within, none."""
        with _naming(self._path), self._pycolmap.DatabaseTransaction(self._database):
            for pair, geometry in geometries:
                written = two_view_geometry(self._pycolmap, geometry)
                if self.has_geometry(pair):
                    self._database.update_two_view_geometry(*pair, written)
                else:
                    self._database.write_two_view_geometry(*pair, written)

    def name(self, image_id: int) -> str:
        """The name of an image, its number where there is none."""
        with contextlib.suppress(Exception):
            return str(self._database.read_image(image_id).name)
        return f"image {image_id}"

    def _image(self, image_id: int) -> DatabaseImage:
        if not self._database.exists_image(image_id):
            raise ValueError(f"there is no image {image_id}")
        image = self._database.read_image(image_id)
        if not self._database.exists_camera(image.camera_id):
            raise ValueError(f"{image.name} has camera {image.camera_id}, which is not there")
        if not self._database.exists_keypoints(image_id):
            raise ValueError(f"{image.name} has no keypoints")
        camera = self._database.read_camera(image.camera_id)
        return database_image(str(image.name), camera, np.asarray(self._database.read_keypoints(image_id)))


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Raises OSError naming the database for what SQLite says of disks and locks."""
    try:
        yield
    except RuntimeError as error:
        said = str(error).partition("SQLite error: ")[2]
        reason = said or "another process holds it, or its disk is full or read-only"
        raise OSError(f"{path} cannot be written: {reason}") from error


def expect_database(path: Path) -> None:
    """Raises FileNotFoundError or ValueError, saying what would be right, for what is no database that can be read."""
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}; give the database of a COLMAP project: database.db")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give the database file in it: {path / 'database.db'}")
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError(f"{path} is not a COLMAP database; give the database.db of a COLMAP project")
    version, tables = _schema(path)
    if missing := ", ".join(sorted(TABLES - tables)):
        raise ValueError(f"{path} is a database, but none of COLMAP's: it has no table {missing}")
    if version > (newest := _newest_version()):
        schemas = f"schema {version}; this pycolmap {imported().__version__} reads up to {newest}"
        raise ValueError(f"{path} was written by a newer COLMAP ({schemas}); pip install --upgrade pycolmap")


def finished_pairs(path: Path, output: Path) -> int:
    """How many pairs of a database have matches, if in the output all of these have a geometry; else 0."""
    with _reading(path) as source, _reading(output) as target:
        pairs = {pair for (pair,) in source.execute("SELECT pair_id FROM matches WHERE rows > 0")}
        done = {pair for (pair,) in target.execute("SELECT pair_id FROM two_view_geometries")}
    return len(pairs) if pairs <= done else 0


def expect_writable(path: Path) -> None:
    """Raises OSError where a database cannot be written to, or another process does: before the work, not after."""
    try:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.rollback()
    except sqlite3.OperationalError as error:
        raise OSError(f"{path} cannot be written: {error}") from error


def copy_database(path: Path, copy: Path) -> None:
    """Copy a database with what other processes have written last, and which may lie in a file beside it."""
    with _reading(path) as source, contextlib.closing(sqlite3.connect(copy)) as target:
        source.backup(target)


def move_database(path: Path, end: Path) -> None:
    """Give a database that nobody writes to another name, in place of what has it."""
    if _beside(path, "wal").exists():  # somebody reads it, and SQLite could not put what was written last into the file
        with replacing(end) as temporary:
            copy_database(path, temporary)
            remove_database(end)
        remove_database(path)
    else:
        remove_database(end)
        os.replace(path, end)


def remove_database(path: Path) -> None:
    """Remove a database and the files that SQLite keeps beside an open one."""
    for name in (path, _beside(path, "wal"), _beside(path, "shm")):
        name.unlink(missing_ok=True)


def _beside(path: Path, kind: str) -> Path:
    return path.with_name(f"{path.name}-{kind}")


def _schema(path: Path) -> tuple[int, set[str]]:
    """The version that COLMAP wrote, and the names of the tables; pycolmap tells neither."""
    try:
        with _reading(path) as connection:
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
            return int(version), {str(name) for (name,) in tables}
    except sqlite3.DatabaseError as error:
        raise ValueError(f"{path} cannot be read as a COLMAP database: {error}") from error


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that only reads; of a folder that cannot be written to as well."""
    mode = "mode=ro" if _beside(path, "wal").exists() else "mode=ro&immutable=1"
    with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)) as connection:
        yield connection


@functools.cache
def _newest_version() -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "empty.db"
        imported().Database.open(path).close()
        return _schema(path)[0]
