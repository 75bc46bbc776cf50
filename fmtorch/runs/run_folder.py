"""The result of one image pair, as one row of a table."""

import dataclasses
import functools
import hashlib
import json
import math
import time
import uuid
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fmtorch.core.files import canonical, create, differences, head, write_whole


@dataclasses.dataclass(frozen=True)
class PairRow:
    """The result of one image pair. What could not be computed is None or NaN, and null in the table.
    A pair of a known homography has a corner error, infinite where it failed, and H in place of F; its NSGD is NaN.
    Raises ValueError for a row that contradicts itself: a failed pair has a reason, NSGD 1 and no F; a sound one has no
    reason and nine finite elements of F or H; NSGD is in [0, 1]; there are both angles of a pose error or neither."""

    pair: str  # the pair's identity within its data set
    key: int  # the pair's stable 64-bit key, `pair_key(pair)`
    family: str  # what results are grouped by
    scene: str  # the cluster for the bootstrap
    ok: bool  # whether there is an estimate
    reason: str = ""  # why not
    nsgd: float = 1.0  # share of the image diagonal, in [0, 1]; 1 where the pair failed
    nsgd_released: float | None = None  # the same as the published evaluator computes it
    inlier_rate: float | None = None  # share of the estimator's inliers that obey the true F, in [0, 1]
    inlier_rate_before: float | None = None  # share of the matches given to the estimator that do
    corrs: int = 0  # the estimator's inliers
    corrs_before: int = 0  # the matches given to the estimator
    features0: int = 0  # features of image 0
    features1: int = 0  # features of image 1
    samples: int = 0  # minimal samples drawn
    seconds_features: float | None = None  # seconds of wall-clock time spent on this pair, stage by stage;
    seconds_matching: float | None = None  # a batch's time is shared equally among its pairs
    seconds_pruning: float | None = None
    seconds_estimation: float | None = None
    seconds_metrics: float | None = None
    F: Sequence[float] | None = None  # row by row, x1^T F x0 = 0 in pixels, unit Frobenius norm
    significance: float | None = None  # how far the support of F is beyond chance
    related: bool = False  # whether the images are therefore taken to show one scene; recall does not ask
    rotation_error: float | None = None  # degrees, in [0, 180]; 180 where the pair failed; None without a true pose
    translation_error: float | None = None  # of directions up to sign, in [0, 90], 90 where it failed; signed: to 180
    pose_reason: str | None = None  # why there is no pose error, or no pose; None where there is
    pair_type: str | None = None  # of `PAIR_TYPES`; None where there are no matches to tell it by
    warning: str | None = None  # what the pair type leaves open, empty where nothing
    focal_error0: float | None = None  # |f - f_true| / f_true of image 0 where f is estimated; infinite where it is
    focal_error1: float | None = None  # not determined; None where it is given exactly, or the true one is unknown
    focal_log_ratio0: float | None = None  # log(f / f_true); None where it is not determined, too
    focal_log_ratio1: float | None = None
    lens_suggested: float | None = None  # lambda of both lenses where matches contradict pinholes
    lens0: float | None = None  # lambda of image 0 where lenses are estimated; None where it is not determined
    lens1: float | None = None
    H: Sequence[float] | None = None  # row by row, x1 ~ H x0 in pixels, unit Frobenius norm
    corner_error: float | None = None  # px in image 1, of the corners of image 0; infinite where the pair failed
    match_precision: float | None = None  # of given matches of known cameras, by OANet's geodesic labels: the share of
    match_recall: float | None = None  # the estimator's inliers that are right, and of all right ones those it found

    def __post_init__(self) -> None:
        planar = self.corner_error is not None
        name, matrix = ("H", self.H) if planar else ("F", self.F)
        error, worst = (self.corner_error, math.inf) if self.corner_error is not None else (self.nsgd, 1.0)
        angles = [a for a in (self.rotation_error, self.translation_error) if a is not None and not math.isnan(a)]
        sound = matrix is not None and len(matrix) == 9 and all(map(math.isfinite, matrix))
        needs = {
            "an nsgd in [0, 1]": planar or 0.0 <= error <= 1.0,
            "a corner error of at least 0, NSGD NaN and no F": not planar
            or (error >= 0.0 and math.isnan(self.nsgd) and self.F is None),
            "angles of both pose errors in [0, 180] degrees, or neither": len(angles) != 1
            and all(0.0 <= a <= 180.0 for a in angles),
            f"nine finite numbers of {name} and no reason, as it is ok": not self.ok or (sound and not self.reason),
            f"a reason, no {name} and the largest error ({worst:g}), and not to be related, as it failed": self.ok
            or (bool(self.reason) and matrix is None and error == worst and not self.related),
        }
        if lacking := [what for what, is_so in needs.items() if not is_so]:
            names = ("ok", "reason", "related", "nsgd", "corner_error", "F", "H", "rotation_error", "translation_error")
            has = ", ".join(f"{name}={getattr(self, name)}" for name in names)
            raise ValueError(f"pair {self.pair!r} needs {lacking[0]}, but has {has}")


_ARROW: dict[Any, pa.DataType] = {
    str: pa.string(), int: pa.int64(), bool: pa.bool_(), float: pa.float64(),
    Sequence[float]: pa.list_(pa.float64()),  # of 9; with a fixed size pyarrow before 26 reads no null
}  # fmt: skip


def _field(name: str, hint: Any) -> pa.Field:
    kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    return pa.field(name, _ARROW[kinds[0]], nullable=type(None) in kinds)


PAIR_SCHEMA = pa.schema([_field(field.name, field.type) for field in dataclasses.fields(PairRow)])


def to_table(rows: Sequence[PairRow]) -> pa.Table:
    """The rows as a table of `PAIR_SCHEMA`; NaN becomes null, but for NSGD's, which says that there is no F."""
    columns = {name: [getattr(row, name) for row in rows] for name in PAIR_SCHEMA.names}
    for name in PAIR_SCHEMA.names:
        if name != "nsgd":
            columns[name] = [None if isinstance(v, float) and math.isnan(v) else v for v in columns[name]]
    return pa.table(columns, schema=PAIR_SCHEMA)


MERGED = 16  # parts of one level that become one of the next
MAX_LEVEL = 3  # 16^3 batches to a part at most: merging needs the memory of one


class PartWriter:
    """Adds parts to a folder, and merges those that it has added itself: any number of writers may do so at once.
    Names sort by the time at which the first rows of a part were written; they end with a digest of the bytes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._own: list[list[Path]] = [[] for _ in range(MAX_LEVEL)]  # by level, in the order of time

    def add(self, table: pa.Table) -> None:
        """Write rows as a new part; where parts have become many, some of them as one."""
        self._kept(self._write(table, f"{time.time_ns():020d}"), 0)

    def _kept(self, path: Path, level: int) -> None:
        if level == MAX_LEVEL:
            return
        parts = self._own[level]
        parts.append(path)
        if len(parts) == MERGED:
            if (merged := self._merge(parts)) is not None:
                self._kept(merged, level + 1)
            parts.clear()

    def _merge(self, parts: Sequence[Path]) -> Path | None:
        """One part in place of several; killed in between, rows are there twice, which readers drop.
        None where one of them is damaged, for a reader to name, or the disk is full: they stay as they are."""
        try:
            merged = self._write(pa.concat_tables([read_part(path) for path in parts]), parts[0].name.split("-")[1])
        except (pa.ArrowException, OSError):
            return None
        for path in parts:
            path.unlink(missing_ok=True)
        return merged

    def _write(self, table: pa.Table, begun: str) -> Path:
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink)
        data = sink.getvalue().to_pybytes()
        # The second word keeps simultaneous writers apart.
        path = self.folder / f"part-{begun}-{uuid.uuid4().hex[:8]}-{content_digest(data)}.parquet"
        write_whole(path, data)
        return path


def part_files(folder: Path) -> list[Path]:
    """The parts in the order that their first rows were written."""
    return sorted(folder.glob("part-*.parquet"))


def part_bytes(path: Path) -> pa.BufferReader:
    """The bytes of a part. Raises ArrowInvalid where they are not those that were written."""
    data = path.read_bytes()
    if path.stem.split("-")[3:] != [content_digest(data)]:
        raise pa.ArrowInvalid("it is not what was written there")
    return pa.BufferReader(data)


def read_part(path: Path) -> pa.Table:
    """The rows of a part. Raises ArrowException or OSError where it cannot be read."""
    with pq.ParquetFile(part_bytes(path)) as parquet:
        return parquet.read()


def content_digest(data: bytes) -> str:
    """Hex digest (blake2b, 64 bits) of a part, which its name ends with."""
    return hashlib.blake2b(data, digest_size=8).hexdigest()


FORMAT = 3  # of the folder; to be raised when the schema changes, or what the identity tells
_LISTINGS = 20  # at most, until parts are those that were listed


class RunFolderError(ValueError):
    """A run folder that cannot be used as asked; the message says what to do."""


def identity_digest(config: Mapping[str, Any]) -> str:
    """The hex digest (blake2b, 128 bits) of what defines a run's results.
    config: plain dicts, lists, strings, numbers, booleans and None: the pipeline's configuration, the data set's name
    and digest, the seed, the digests of learned files, the version. Raises TypeError for anything else."""
    return hashlib.blake2b(canonical(config).encode(), digest_size=16).hexdigest()


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """An evaluation on disk; made by `open` (to write) or `load` (to read)."""

    path: Path
    config: dict[str, Any]  # what defines the results, see `identity_digest`

    @classmethod
    def open(cls, path: Path | str, config: Mapping[str, Any]) -> "RunFolder":
        """Start a run in `path`, or continue it there when the folder holds a run of the same identity.
        For several processes at once. Raises RunFolderError, touching nothing, for another run and for other files."""
        path = Path(path)
        wanted: dict[str, Any] = json.loads(canonical(config))
        if path.exists() and not path.is_dir():
            raise RunFolderError(f"{path} is a file; output must name a folder")
        path.mkdir(parents=True, exist_ok=True)
        foreign = sorted(entry.name for entry in path.iterdir() if entry.suffix != ".tmp")
        if not (path / "run.json").exists():
            if foreign:
                problem = f"is not empty and has no run.json, so it is no run folder (it holds {head(foreign)})"
                raise RunFolderError(f"{path} {problem}; choose another output")
            stored = {"format": FORMAT, "identity": identity_digest(wanted), "config": wanted}
            create(path / "run.json", json.dumps(stored, indent=2) + "\n")
        folder = cls.load(path)
        if folder.identity != identity_digest(wanted):
            differing = f"what differs (there -> now): {differences(folder.config, wanted)}"
            raise RunFolderError(f"{path} holds another run; {differing}. Choose another output, or delete the folder")
        (path / "pairs").mkdir(exist_ok=True)
        return folder

    @classmethod
    def load(cls, path: Path | str) -> "RunFolder":
        """The existing run in `path`, whatever its identity. Raises RunFolderError where there is none."""
        file = Path(path) / "run.json"
        try:
            stored = json.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise RunFolderError(f"{path} is no run folder: it has no run.json") from None
        except ValueError as error:
            raise RunFolderError(f"{file} is not valid JSON ({error}); delete the folder and run again") from error
        if not isinstance(stored, dict) or not isinstance(stored.get("config"), dict):
            raise RunFolderError(f"{file} was not written by this program: it has no 'config'")
        if stored.get("format") != FORMAT:
            formats = f"has format {stored.get('format')}, this version reads {FORMAT}"
            raise RunFolderError(f"{file} {formats}; choose another output")
        if stored.get("identity") != identity_digest(stored["config"]):
            remedy = "put it back as it was, or delete the folder and run again"
            raise RunFolderError(f"{file} was changed: its identity is not that of its config; {remedy}")
        return cls(Path(path), stored["config"])

    @property
    def identity(self) -> str:
        return identity_digest(self.config)

    def append(self, rows: Sequence[PairRow]) -> None:
        if rows:
            self._writer.add(to_table(rows))

    def done(self) -> set[int]:
        return {int(key) for part in self._parts(["key"]) for key in part["key"].to_numpy()}

    def read(self, keys: Collection[int] | None = None, without: Collection[str] = ()) -> pa.Table:
        """The results, a row of `PAIR_SCHEMA` per pair, without some columns: all, or those of the given keys.
        Of several rows of a pair the first counts. Raises RunFolderError naming a part that cannot be read."""
        names = [name for name in PAIR_SCHEMA.names if name not in without]
        table = pa.concat_tables([PAIR_SCHEMA.empty_table().select(names), *self._parts(names)])
        stored_keys = table["key"].to_numpy()
        _, first = np.unique(stored_keys, return_index=True)
        if keys is not None:
            first = first[np.isin(stored_keys[first], np.fromiter(keys, np.int64, len(keys)))]
        return table.take(np.sort(first))

    def write_summary(self, summary: Mapping[str, Any], markdown: str) -> None:
        """Write ``summary.json`` and ``summary.md``. Raises ValueError for NaN, which JSON does not have."""
        write_whole(self.path / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
        write_whole(self.path / "summary.md", markdown)

    @functools.cached_property
    def _writer(self) -> PartWriter:
        return PartWriter(self.path / "pairs")

    def _parts(self, columns: list[str]) -> list[pa.Table]:
        """The parts in the order they were written; of a part's columns only those asked for."""
        parts: list[pa.Table] | None = None
        for _ in range(_LISTINGS):  # another process may merge parts while they are read
            files = part_files(self.path / "pairs")
            try:
                parts = [self._part(file, columns) for file in files]
            except FileNotFoundError:
                continue
            if part_files(self.path / "pairs") == files:
                return parts
        if parts is None:
            raise RunFolderError(f"{self.path}: its parts cannot be read while others merge them; try again")
        return parts

    def _part(self, file: Path, columns: list[str]) -> pa.Table:
        try:
            with pq.ParquetFile(part_bytes(file)) as parquet:
                if not parquet.schema_arrow.equals(PAIR_SCHEMA):
                    raise pa.ArrowInvalid("its columns are not those of this version")
                return parquet.read(columns=columns)
        except FileNotFoundError:
            raise
        except (pa.ArrowException, OSError) as error:
            remedy = "delete it and start the run again, which computes its pairs anew"
            raise RunFolderError(f"{file} cannot be read ({error}); {remedy}") from error
