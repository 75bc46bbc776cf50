"""What is to be exported, image by image and pair by pair, as files that are whole or absent: work can be resumed.

::

    images/<digest>.npz   keypoints, scores, size, camera of an image; the digest is of its name and its file's bytes
    pairs/<digest>.npz    indices of matched keypoints, their scores, F, its inliers and significance, and the two-view
                          geometry for COLMAP; the digest is of the two images' digests
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fmtorch.core.files import replacing
from fmtorch.data.lenses import Lens
from fmtorch.storage.exchange.two_view import Kind, PairGeometry

Array = NDArray[np.float64]
_PAIR = ("matches", "scores", "inliers", "F", "related", "significance", "configuration")
_GEOMETRY = ("F", "E", "H", "R", "t")  # matrices of a geometry, of those that there are


@dataclasses.dataclass(frozen=True, eq=False)
class ExportedImage:
    """An image: points (n, 2) in pixels, (0, 0) at the first pixel's centre; scores (n,); size (h, w).

    K: of an image without distortion; lens: of one with it; focal: of EXIF, px; of all three one at most.
    """

    name: str
    points: NDArray[np.float32]
    scores: NDArray[np.float32]
    size: tuple[int, int]
    K: Array | None = None
    lens: Lens | None = None
    focal: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class ExportedPair:
    """The matches given to the estimator, (m, 2) indices of points; scores (m,) in [0, 1]; inliers (m,) of F (3, 3).

    F is zero where there is none. related: whether its support is beyond chance. significance: how far, -inf without F
    and NaN where it was not computed. configuration: of the cameras and the scene; empty where it is not known, and
    geometry, for COLMAP, None.
    """

    name0: str
    name1: str
    matches: NDArray[np.int32]
    scores: NDArray[np.float32]
    inliers: NDArray[np.bool_]
    F: Array
    related: bool = True
    geometry: PairGeometry | None = None
    significance: float = math.nan
    configuration: str = ""


@dataclasses.dataclass(frozen=True)
class Journal:
    """The folder of what was computed; names of images are paths below `root`. Any number of processes may add."""

    folder: Path
    root: Path

    def name(self, image: Path) -> str:
        """Under what name an image is exported."""
        return image.absolute().relative_to(self.root.absolute()).as_posix()

    def has_image(self, image: Path) -> bool:
        return self._image(image).exists()

    def has_pair(self, image0: Path, image1: Path) -> bool:
        return self._pair(image0, image1).exists()

    def add_image(self, image: Path, value: ExportedImage) -> None:
        arrays: dict[str, NDArray[Any]] = {"points": value.points, "scores": value.scores, "size": np.array(value.size)}
        if value.K is not None:
            arrays["K"] = value.K
        if value.focal is not None:
            arrays["focal"] = np.array(value.focal)
        if (lens := value.lens) is not None:
            arrays["lens_model"] = np.array(lens.model)
            arrays["lens"] = np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.coefficients])
        _write(self._image(image), arrays)

    def add_pair(self, image0: Path, image1: Path, value: ExportedPair) -> None:
        arrays: dict[str, NDArray[Any]] = {name: np.asarray(getattr(value, name)) for name in _PAIR}
        if (geometry := value.geometry) is not None:
            arrays |= {"kind": np.array(geometry.kind), "geometry_inliers": np.asarray(geometry.inliers)}
            matrices = {f"geometry_{name}": getattr(geometry, name) for name in _GEOMETRY}
            arrays |= {name: matrix for name, matrix in matrices.items() if matrix is not None}
        _write(self._pair(image0, image1), arrays)

    def image(self, image: Path) -> ExportedImage:
        with np.load(self._image(image)) as stored:
            h, w = stored["size"].tolist()
            K, lens, focal = stored.get("K"), None, stored.get("focal")
            if "lens" in stored:
                fx, fy, cx, cy, *coefficients = stored["lens"].tolist()
                lens = Lens(fx, fy, cx, cy, str(stored["lens_model"]), tuple(coefficients))
            points, scores, given = stored["points"], stored["scores"], None if focal is None else float(focal)
            return ExportedImage(self.name(image), points, scores, (h, w), K, lens, given)

    def pair(self, image0: Path, image1: Path) -> ExportedPair:
        with np.load(self._pair(image0, image1)) as stored:
            values = {name: stored[name] for name in _PAIR}
            geometry = None
            if "kind" in stored:
                matrices = [stored.get(f"geometry_{name}") for name in _GEOMETRY]
                geometry = PairGeometry(cast(Kind, str(stored["kind"])), stored["geometry_inliers"], *matrices)
        values |= {name: values[name].item() for name in ("related", "significance", "configuration")}
        return ExportedPair(self.name(image0), self.name(image1), geometry=geometry, **values)

    def _image(self, image: Path) -> Path:
        return self.folder / "images" / f"{self._digest(image)}.npz"

    def _pair(self, image0: Path, image1: Path) -> Path:
        both = f"{self._digest(image0)} {self._digest(image1)}"
        return self.folder / "pairs" / f"{hashlib.blake2b(both.encode(), digest_size=16).hexdigest()}.npz"

    def _digest(self, image: Path) -> str:
        status = image.stat()
        return _digest(self.name(image), image.absolute(), status.st_size, status.st_mtime_ns)


def indices(points: NDArray[np.float32], x: NDArray[np.float32]) -> NDArray[np.int32]:
    """Which of the points, (n, 2), each of x, (m, 2), is: the first at that location.

    Raises ValueError where x holds a point that is none of them: a matcher that moves points cannot be exported so.
    """
    place = {tuple(point): i for i, point in reversed(list(enumerate(points.tolist())))}
    try:
        return np.array([place[tuple(point)] for point in x.tolist()], np.int32)
    except KeyError as error:
        raise ValueError(f"the match at {error.args[0]} is at no keypoint; such matches cannot be exported") from None


@functools.lru_cache(maxsize=100_000)
def _digest(name: str, path: Path, size: int, changed: int) -> str:
    digest = hashlib.blake2b(f"{name}\0".encode(), digest_size=16)
    with path.open("rb") as file:
        digest.update(hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()


def _write(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
