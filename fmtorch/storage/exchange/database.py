"""A COLMAP database of anyone's keypoints and matches: read pair by pair, and given two-view geometries."""

from __future__ import annotations

import contextlib
import functools
import os
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.files import replacing
from fmtorch.storage.exchange.colmap import imported
from fmtorch.storage.exchange.database_images import DatabaseImage, database_image
from fmtorch.storage.exchange.two_view import PairGeometry, two_view_geometry

MAGIC = b"SQLite format 3\0"
TABLES = {"cameras", "images", "keypoints", "matches", "two_view_geometries"}
BLOCK = 64  # images: pairs are sorted by blocks of both images, so that keypoints are read seldom
MEMORY = 2 * BLOCK + 1  # images whose keypoints are kept

Ids = tuple[int, int]


class MatchDatabase:
    """An open database. Its images are read when they are needed, and few of them are kept.

    Raises what `expect_database` raises, and ValueError where there are no keypoints or no matches; OSError where the
    disk is full or another process holds the database.
    """

    def __init__(self, path: Path) -> None:
        self._pycolmap = imported()
        expect_database(path)
        self._path = path
        with _naming(path):
            self._database = self._pycolmap.Database.open(path)
        self.image = functools.lru_cache(maxsize=MEMORY)(self._image)
        for count, what, step in (
            (self._database.num_keypoints(), "keypoints", "extract features (colmap feature_extractor)"),
            (self._database.num_matched_image_pairs(), "matches", "match the images (colmap exhaustive_matcher)"),
        ):
            if not count:
                self.close()
                raise ValueError(f"{path} holds no {what}; {step} first")

    def __enter__(self) -> MatchDatabase:
        """The database itself, closed on leaving."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the database."""
        self.close()

    def close(self) -> None:
        """Close the database; SQLite then leaves one file."""
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
        """Whether a pair has a two-view geometry, of a failure too."""
        return bool(self._database.exists_two_view_geometry(*pair))

    def matches(self, pair: Ids) -> NDArray[np.int64]:
        """The matches of a pair, keypoints (n, 2) of its images.

        Raises ValueError where there are no such keypoints.
        """
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
        raise OSError(
            f"{path} cannot be written: {said or 'another process holds it, or its disk is full or read-only'}"
        ) from error


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
    missing = TABLES - tables
    if missing:
        raise ValueError(f"{path} is a database, but none of COLMAP's: it has no table {', '.join(sorted(missing))}")
    if version > (newest := _newest_version()):
        raise ValueError(
            f"{path} was written by a newer COLMAP (schema {version}; this pycolmap {imported().__version__} "
            f"reads up to {newest}); pip install --upgrade pycolmap"
        )


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
    address = path.absolute().as_uri()
    waiting = _beside(path, "wal").exists()
    with contextlib.closing(
        sqlite3.connect(f"{address}?mode=ro{'' if waiting else '&immutable=1'}", uri=True)
    ) as open_:
        yield open_


@functools.cache
def _newest_version() -> int:
    """The version that pycolmap writes into databases."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "empty.db"
        opened: Any = imported().Database.open(path)
        opened.close()
        return _schema(path)[0]
