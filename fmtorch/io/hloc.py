"""hloc's files of features and matches: read pair by pair, and written anew with the matches that were verified."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.files import replacing
from fmtorch.data.text_files import DataError
from fmtorch.io import h5
from fmtorch.io.colmap import DatabaseImage
from fmtorch.io.match_store import PairGeometry

MEMORY = 256  # images whose keypoints are kept
NO_MATCH = -1
Names = tuple[str, str]


class HlocMatches:
    """The pairs of two files; output: the file of matches that is written.

    Raises DataError where one of the files is no HDF5 file, or holds no keypoints or no matches.
    """

    def __init__(self, features: Path, matches: Path, output: Path) -> None:
        self._output, self._open = output, contextlib.ExitStack()
        self.files = (features, matches)
        with contextlib.ExitStack() as stack:
            self._features, self._matches = (stack.enter_context(h5.opened(path)) for path in (features, matches))
            images = _below(self._features, "keypoints")
            if not images:
                raise DataError(f"{features} holds no keypoints; give hloc's file of features")
            self._stored = {name.replace("/", "-"): name for name in images}
            self._keys = {self._named(key): key for key in _below(self._matches, "matches0")}
            if not self._keys:
                raise DataError(f"{matches} holds no matches0; give hloc's file of matches")
            self._open = stack.pop_all()
        self.image = functools.lru_cache(maxsize=MEMORY)(self._image)

    def __enter__(self) -> HlocMatches:
        """The files themselves, closed on leaving."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the files."""
        self._open.close()

    def pairs(self) -> list[Names]:
        """The pairs of the file of matches, by the names of their images."""
        return sorted(self._keys)

    def identity(self) -> dict[str, Any]:
        """What the files hold."""
        return {"files": h5.digest_of(*self.files)}

    def has_geometry(self, pair: Names) -> bool:
        """Whether a pair has a geometry: none has."""
        return False

    def matches(self, pair: Names) -> NDArray[np.int64]:
        """The matches of a pair, keypoints (n, 2). Raises DataError where there are no such keypoints."""
        second = self._second(pair)
        counts = [len(self.image(name).points) for name in pair]
        if len(second) != counts[0]:
            raise DataError(f"matches0 has {len(second)} entries, but {pair[0]} has {counts[0]} keypoints")
        if len(second) and not NO_MATCH <= second.min() <= second.max() < counts[1]:
            raise DataError(f"matches0 holds {second.min()} to {second.max()}, but {pair[1]} has {counts[1]} keypoints")
        first = np.flatnonzero(second != NO_MATCH)
        return np.stack([first, second[first]], -1)

    def write(self, geometries: Iterable[tuple[Names, PairGeometry]]) -> None:
        """Write the file: `matches0` of inliers alone, their scores, and the matrices as attributes."""
        h5py = h5.imported()
        with replacing(self._output) as temporary, h5py.File(temporary, "w") as file:
            for pair, geometry in geometries:
                group = file.create_group(self._keys[pair])
                second = np.full(len(self._second(pair)), NO_MATCH, np.int32)
                second[geometry.inliers[:, 0]] = geometry.inliers[:, 1]
                group["matches0"] = second
                scores = self._scores(pair)
                if scores is not None:
                    group["matching_scores0"] = np.where(second == NO_MATCH, 0, scores).astype(np.float32)
                write_geometry(group, geometry)

    def name(self, image_id: str) -> str:
        """The name itself."""
        return image_id

    def _named(self, key: str) -> Names:
        """The names of a pair's images; of an image without features that in the key."""
        first, _, second = key.rpartition("/")
        return self._stored.get(first, first), self._stored.get(second, second)

    def _second(self, pair: Names) -> NDArray[np.int64]:
        values = h5.array(self._matches, f"{self._keys[pair]}/matches0", None)
        if values.dtype.kind not in "iu":
            raise DataError(f"matches0 is of {values.dtype}; it must hold whole numbers")
        return values.astype(np.int64)

    def _scores(self, pair: Names) -> NDArray[np.float64] | None:
        key = f"{self._keys[pair]}/matching_scores0"
        return h5.numbers(self._matches, key, None) if h5.holds(self._matches, key) else None

    def _image(self, name: str) -> DatabaseImage:
        points = h5.numbers(self._features, f"{name}/keypoints", None, 2).astype(np.float32)
        width, height = h5.reshaped(self._features, f"{name}/image_size", 2)
        size = int(height), int(width)
        return DatabaseImage(name, -1, size, np.eye(3), np.inf, points, points)


def write_geometry(group: Any, geometry: PairGeometry) -> None:
    """The configuration and the matrices of a pair as attributes of its group."""
    group.attrs["configuration"] = geometry.kind
    for name in ("F", "E", "H", "R", "t"):
        value = getattr(geometry, name)
        if value is not None:
            group.attrs[name] = value


def _below(file: Any, last: str) -> list[str]:
    """The paths of the groups that hold an array of that name, at any depth."""
    groups: list[str] = []

    def visit(name: str) -> None:
        head, _, end = name.rpartition("/")
        if end == last and head:
            groups.append(head)

    try:
        file.visit(visit)
    except (OSError, RuntimeError) as error:
        raise DataError(f"{file.filename}: its keys cannot be read ({str(error).splitlines()[0]})") from error
    return groups
