"""Matches alone: x0, x1 of one pair or of many in an npz or HDF5 file, and their geometries in another."""

from __future__ import annotations

import contextlib
import functools
import shutil
import uuid
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.files import replacing
from fmtorch.data.text_files import DataError
from fmtorch.geometry.cameras import calibration_problems
from fmtorch.io import h5
from fmtorch.io.colmap import DatabaseImage
from fmtorch.io.given import size_by_centre
from fmtorch.io.match_store import PairGeometry

NPZ = ".npz"
SUFFIXES = (NPZ, *h5.SUFFIXES)
MATRICES = ("F", "E", "H", "R", "t")
MEMORY = 256  # images whose points are kept

Side = tuple[str, int]  # pair, and 0 or 1 of its images
Ids = tuple[Side, Side]


class ArrayFile(Protocol):
    """Arrays by keys such as ``a/x0``."""

    def keys(self) -> Iterable[str]:
        """All of them."""

    def read(self, key: str) -> NDArray[Any]:
        """One array; raises DataError where it cannot be read."""


class MatchFile:
    """The pairs of one file; each has matches of its own. Geometries are kept in a folder, a file a batch, until
    `finish`.

    A file holds ``x0, x1`` (n, 2), pixels with (0, 0) at the centre of the first one, and perhaps ``K0, K1`` (3, 3) and
    ``size0, size1`` (h, w): of one pair, or of each pair below a name of its own (``a/x0``; in HDF5 a group).

    Raises DataError where the file is of another kind or holds no such pair.
    """

    def __init__(self, path: Path, parts: Path) -> None:
        self._path, self._parts, self._open = path, parts, contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            self._file = stack.enter_context(_arrays(path))
            self._keys = set(self._file.keys())
            ends = [key.removesuffix("x0") for key in self._keys if key.rpartition("/")[2] == "x0"]
            self._pairs = sorted(end for end in ends if f"{end}x1" in self._keys)
            if not self._pairs:
                raise DataError(
                    f"{path} holds no x0 and x1; give matches x0, x1 (n, 2), alone or of each pair in a group, "
                    "or hloc's features=F.h5 as well"
                )
            self._open = stack.pop_all()
        parts.mkdir(exist_ok=True)
        self._done = {pair for part in self._stored() for pair in _pairs_of(part)}
        self.image = functools.lru_cache(maxsize=MEMORY)(self._image)

    def __enter__(self) -> MatchFile:
        """The file itself, closed on leaving."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the file."""
        self._open.close()

    def pairs(self) -> list[Ids]:
        """Both images of each pair."""
        return [((pair, 0), (pair, 1)) for pair in self._pairs]

    def has_geometry(self, pair: Ids) -> bool:
        """Whether an interrupted run had a pair."""
        return pair[0][0] in self._done

    def matches(self, pair: Ids) -> NDArray[np.int64]:
        """Point i with point i. Raises DataError where x0 and x1 have different lengths."""
        counts = [len(self.image(side).points) for side in pair]
        if counts[0] != counts[1]:
            raise DataError(f"x0 has {counts[0]} points and x1 has {counts[1]}; they must have as many")
        return np.repeat(np.arange(counts[0])[:, None], 2, 1)

    def write(self, geometries: Iterable[tuple[Ids, PairGeometry]]) -> None:
        """Keep geometries of pairs: which matches are inliers, configuration and matrices."""
        entries: dict[str, NDArray[Any]] = {}
        for ((pair, _), _), geometry in geometries:
            inliers = np.zeros(len(self.image((pair, 0)).points), bool)
            inliers[geometry.inliers[:, 0]] = True
            entries |= {f"{pair}inliers": inliers, f"{pair}configuration": np.array(geometry.kind)}
            values = ((name, getattr(geometry, name)) for name in MATRICES)
            entries |= {f"{pair}{name}": value for name, value in values if value is not None}
        with replacing(self._parts / f"{uuid.uuid4().hex}{NPZ}") as temporary:
            _write_npz(temporary, [entries])

    def name(self, image_id: Side) -> str:
        """The key of the points."""
        return f"{image_id[0]}x{image_id[1]}"

    def finish(self, output: Path) -> None:
        """Write one file of all pairs and remove the folder."""
        with replacing(output) as temporary:
            parts = (_read_npz(part) for part in self._stored())
            (_write_npz if output.suffix == NPZ else _write_h5)(temporary, parts)
        shutil.rmtree(self._parts)

    def _stored(self) -> list[Path]:
        return sorted(self._parts.glob(f"*{NPZ}"))

    def _image(self, image_id: Side) -> DatabaseImage:
        pair, i = image_id
        points = self._numbers(f"{pair}x{i}", (None, 2)).astype(np.float32)
        K, size = (
            self._numbers(f"{pair}{key}", shape) if f"{pair}{key}" in self._keys else None
            for key, shape in ((f"K{i}", (3, 3)), (f"size{i}", (2,)))
        )
        if K is not None and (problem := calibration_problems(torch.from_numpy(K)[None], None, f"K{i}")[0]):
            raise DataError(problem)
        known = size_by_centre(K) if size is None and K is not None else None
        if size is not None:
            if not (np.isfinite(size).all() and (size >= 1).all()):
                raise DataError(f"size{i} is {size.tolist()}; it must be the height and width of the image")
            known = int(size[0]), int(size[1])
        deviation = np.inf if K is None else 0.0
        return DatabaseImage(self.name(image_id), i, known, K, deviation, points, points)

    def _numbers(self, key: str, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
        values = self._file.read(key)
        if values.dtype.kind not in "fiu":
            raise DataError(f"{key} is of {values.dtype}; it must hold real numbers")
        fits = values.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, values.shape, strict=True))
        if not fits:
            wanted = ", ".join("n" if n is None else str(n) for n in shape)
            raise DataError(f"{key} has shape {values.shape}; it must be ({wanted})")
        return values.astype(np.float64)


def expect_suffix(name: str, path: Path) -> None:
    """Raise ValueError where a file of matches ends otherwise than in .npz, .h5 or .hdf5."""
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{name}={path} must end in {', '.join(SUFFIXES)}")


@contextlib.contextmanager
def _arrays(path: Path) -> Iterator[ArrayFile]:
    if path.suffix != NPZ:
        with h5.opened(path) as file:
            yield _H5(file)
        return
    try:
        npz = np.load(path)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: is not a valid npz file; write it by numpy.savez") from error
    if not isinstance(npz, np.lib.npyio.NpzFile):
        raise DataError(f"{path}: is a single array; write x0 and x1 by numpy.savez")
    with npz:
        yield _Npz(npz)


class _Npz:
    def __init__(self, file: Any) -> None:
        self._file = file

    def keys(self) -> list[str]:
        return list(self._file.files)

    def read(self, key: str) -> NDArray[Any]:
        try:
            return np.asarray(self._file[key])
        except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
            raise DataError(f"{key} cannot be read ({str(error).partition(chr(10))[0]})") from error


class _H5:
    def __init__(self, file: Any) -> None:
        self._file = file

    def keys(self) -> list[str]:
        names: list[str] = []
        try:
            self._file.visit(names.append)
        except (OSError, RuntimeError) as error:
            raise DataError(f"{self._file.filename}: its keys cannot be read") from error
        return names

    def read(self, key: str) -> NDArray[Any]:
        return h5.array(self._file, key)


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path) as npz:
        return dict(npz)


def _pairs_of(part: Path) -> list[str]:
    with np.load(part) as npz:
        return [key.removesuffix("configuration") for key in npz.files if key.rpartition("/")[2] == "configuration"]


def _write_npz(path: Path, batches: Iterable[Mapping[str, NDArray[Any]]]) -> None:
    """As `numpy.savez` writes it, with one batch in memory."""
    with zipfile.ZipFile(path, "w") as archive:
        for batch in batches:
            for key, value in batch.items():
                with archive.open(f"{key}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asarray(value), allow_pickle=False)


def _write_h5(path: Path, batches: Iterable[Mapping[str, NDArray[Any]]]) -> None:
    """`inliers` as a data set of each pair's group, the others as its attributes."""
    h5py = h5.imported()
    with h5py.File(path, "w") as file:
        for batch in batches:
            for key, value in batch.items():
                pair, _, name = key.rpartition("/")
                group = file.require_group(pair or "/")
                if name == "inliers":
                    group[name] = value
                else:
                    group.attrs[name] = str(value) if name == "configuration" else value
