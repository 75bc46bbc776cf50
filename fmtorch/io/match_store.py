"""What is to be exported, image by image and pair by pair, as files that are whole or absent: work can be resumed.

::

    images/<digest>.npz   keypoints, scores, size, camera of an image; the digest is of its name and its file's bytes
    pairs/<digest>.npz    indices of matched keypoints, their scores, F, its inliers and significance, and the two-view
                          geometry for COLMAP; the digest is of the two images' digests"""

import dataclasses
import functools
import hashlib
import math
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from fmtorch.core.files import replacing
from fmtorch.core.lenses import Lens
from fmtorch.data.files import Array, Indices, Mask, Matrix, Singles

ORIGIN = 0.5  # px: COLMAP's coordinates of the first pixel's centre

Kind = Literal["calibrated", "uncalibrated", "planar", "panoramic", "planar_or_panoramic", "degenerate"]
"""COLMAP's configurations: of a general pair by whether both focal lengths are known, of others by what they show."""
MATRICES = ("F", "E", "H", "R", "t")


class PairGeometry(NamedTuple):
    """The geometry of one pair, in pixels with (0, 0) at the centre of the first one.
    inliers: keypoints of both images, (n, 2). F, E, H: (3, 3), None where there is none; ``x1^T F x0 = 0``,
    ``x1 ~ H x0``. R, t: X1 = R X0 + t. reason: why there is no F. warning: what matches leave open or contradict."""

    kind: Kind
    inliers: Array
    F: Matrix | None = None
    E: Matrix | None = None
    H: Matrix | None = None
    R: Matrix | None = None
    t: Matrix | None = None
    reason: str = ""
    warning: str = ""

    @property
    def matrices(self) -> dict[str, Matrix]:
        """Those of `MATRICES` that the pair has."""
        return {name: value for name in MATRICES if (value := getattr(self, name)) is not None}

    @property
    def texts(self) -> dict[str, str]:
        """What files say of the pair in words: its configuration, and reason and warning where there are any."""
        texts = {"configuration": self.kind, "reason": self.reason, "warning": self.warning}
        return {name: text for name, text in texts.items() if text}


def two_view_geometry(pycolmap: Any, pair: PairGeometry) -> Any:
    """The `pycolmap.TwoViewGeometry` of a pair: F and H in COLMAP's pixels."""
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.__members__[pair.kind.upper()]
    geometry.inlier_matches = np.ascontiguousarray(pair.inliers, np.uint32)
    back = np.array([[1.0, 0, -ORIGIN], [0, 1, -ORIGIN], [0, 0, 1]])
    if pair.F is not None:
        geometry.F = back.T @ pair.F @ back
    if pair.E is not None:
        geometry.E = pair.E / np.linalg.norm(pair.E)
    if pair.H is not None:
        geometry.H = np.linalg.inv(back) @ pair.H @ back
    if pair.R is not None and pair.t is not None:
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(pair.R), pair.t)
    return geometry


_PAIR = ("matches", "scores", "inliers", "F", "related", "significance", "pair_type")


@dataclasses.dataclass(frozen=True, eq=False)
class StoredImage:
    """An image: points (n, 2) in pixels, (0, 0) at the first pixel's centre; scores (n,); size (h, w).
    K: of an image without distortion; lens: of one with it; focal: of EXIF, px; of all three one at most."""

    name: str
    points: Singles
    scores: Singles
    size: tuple[int, int]
    K: Matrix | None = None
    lens: Lens | None = None
    focal: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class StoredPair:
    """The matches given to the estimator, (m, 2) indices of points; scores (m,) in [0, 1]; inliers (m,) of F (3, 3).
    F is zero where there is none. related: whether its support is beyond chance. significance: how far, -inf without F
    and NaN where it was not computed. pair_type: empty where it is not known. geometry: for COLMAP."""

    name0: str
    name1: str
    matches: Array
    scores: Singles
    inliers: Mask
    F: Matrix
    related: bool = True
    geometry: PairGeometry | None = None
    significance: float = math.nan
    pair_type: str = ""


class MatchRecords(NamedTuple):
    """Images and pairs by the paths of images; names within are no matter, since a store names by its root."""

    images: dict[Path, StoredImage]
    pairs: dict[tuple[Path, Path], StoredPair]


@dataclasses.dataclass(frozen=True)
class MatchStore:
    """The folder of what was computed; names of images are paths below `root`. Any number of processes may add."""

    folder: Path
    root: Path

    def name(self, image: Path) -> str:
        return image.absolute().relative_to(self.root.absolute()).as_posix()

    def add(self, records: MatchRecords) -> None:
        """Add what it does not have; a pair after its images."""
        for image, value in records.images.items():
            if not self.has_image(image):
                self.add_image(image, value)
        for ends, pair in records.pairs.items():
            if not self.has_pair(*ends):
                self.add_pair(*ends, pair)

    def has_image(self, image: Path) -> bool:
        return self._image(image).exists()

    def has_pair(self, image0: Path, image1: Path) -> bool:
        return self._pair(image0, image1).exists()

    def add_image(self, image: Path, value: StoredImage) -> None:
        arrays: dict[str, Array] = {"points": value.points, "scores": value.scores, "size": np.array(value.size)}
        arrays |= {name: np.asarray(k) for name in ("K", "focal") if (k := getattr(value, name)) is not None}
        if (lens := value.lens) is not None:
            arrays["lens_model"] = np.array(lens.model)
            arrays["lens"] = np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.coefficients])
        _write(self._image(image), arrays)

    def add_pair(self, image0: Path, image1: Path, value: StoredPair) -> None:
        arrays: dict[str, Array] = {name: np.asarray(getattr(value, name)) for name in _PAIR}
        if (geometry := value.geometry) is not None:
            arrays |= {"kind": np.array(geometry.kind), "geometry_inliers": np.asarray(geometry.inliers)}
            arrays |= {f"geometry_{name}": matrix for name, matrix in geometry.matrices.items()}
        _write(self._pair(image0, image1), arrays)

    def image(self, image: Path) -> StoredImage:
        with np.load(self._image(image)) as stored:
            h, w = stored["size"].tolist()
            K, lens, focal = stored.get("K"), None, stored.get("focal")
            if "lens" in stored:
                fx, fy, cx, cy, *coefficients = stored["lens"].tolist()
                lens = Lens(fx, fy, cx, cy, str(stored["lens_model"]), tuple(coefficients))
            points, scores, given = stored["points"], stored["scores"], None if focal is None else float(focal)
            return StoredImage(self.name(image), points, scores, (h, w), K, lens, given)

    def pair(self, image0: Path, image1: Path) -> StoredPair:
        with np.load(self._pair(image0, image1)) as stored:
            values = {name: stored[name] for name in _PAIR}
            geometry = None
            if "kind" in stored:
                matrices = [stored.get(f"geometry_{name}") for name in MATRICES]
                geometry = PairGeometry(cast(Kind, str(stored["kind"])), stored["geometry_inliers"], *matrices)
        values |= {name: values[name].item() for name in ("related", "significance", "pair_type")}
        return StoredPair(self.name(image0), self.name(image1), geometry=geometry, **values)

    def _image(self, image: Path) -> Path:
        return self.folder / "images" / f"{self._digest(image)}.npz"

    def _pair(self, image0: Path, image1: Path) -> Path:
        both = f"{self._digest(image0)} {self._digest(image1)}"
        return self.folder / "pairs" / f"{hashlib.blake2b(both.encode(), digest_size=16).hexdigest()}.npz"

    def _digest(self, image: Path) -> str:
        status = image.stat()
        return _digest(self.name(image), image.absolute(), status.st_size, status.st_mtime_ns)


def indices(points: Singles, x: Singles) -> Array:
    """Which of the points, (n, 2), each of x, (m, 2), is: the first at that location.
    Raises ValueError where x holds a point that is none of them: a matcher that moves points cannot be exported so."""
    keys, wanted = _keys(points), _keys(x)
    order = np.argsort(keys, kind="stable")
    place = np.searchsorted(keys, wanted, sorter=order)
    index = order[np.minimum(place, len(order) - 1)] if len(order) else np.zeros(len(wanted), np.int64)
    absent = np.ones(len(wanted), bool) if not len(order) else keys[index] != wanted
    if absent.any():
        point = tuple(x[absent.argmax()].tolist())
        raise ValueError(f"the match at {point} is at no keypoint; such matches cannot be exported")
    return index.astype(np.int32)


def _keys(points: Singles) -> Indices:
    """The bits of both coordinates of each point, (n,); 0 and -0 are one."""
    return np.ascontiguousarray(points + np.float32(0), np.float32).view(np.int64)[:, 0]


@functools.lru_cache(maxsize=100_000)
def _digest(name: str, path: Path, size: int, changed: int) -> str:
    digest = hashlib.blake2b(f"{name}\0".encode(), digest_size=16)
    with path.open("rb") as file:
        digest.update(hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()


def _write(path: Path, arrays: dict[str, Array]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
