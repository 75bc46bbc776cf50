"""The layout of the RANSAC tutorial (CVPR 2020): a folder for each scene, with ``matches.h5`` and its neighbours.

Of each pair ``<image0>-<image1>``: ``matches`` (n, 4) as x0, y0, x1, y1 in pixels; ``match_conf`` (n,), the ratio of
distances, smaller being better; ``K1_K2``, the two calibration matrices, in whatever shape they were stored. Of each
image: ``R`` (3, 3) and ``T`` (3,), world to camera. The test split has no R and T; ``Fgt``, where there is one, is
used instead.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data.images import stored_size
from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource
from fmtorch.data.text_files import DataError
from fmtorch.io import h5
from fmtorch.io.given import (
    Array,
    Size,
    broken,
    calibrated,
    expect_size,
    given,
    image,
    posed,
    size_by_centre,
    size_by_points,
    with_fundamentals,
)

MATCHES, RATIOS, CALIBRATIONS, ROTATIONS, TRANSLATIONS, TRUTH = (
    f"{name}.h5" for name in ("matches", "match_conf", "K1_K2", "R", "T", "Fgt")
)


@dataclasses.dataclass(frozen=True)
class TutorialMatches:
    """The matches of one pair."""

    folder: Path
    key: str
    sizes: tuple[Size, Size]

    def __call__(self) -> GivenMatches:
        """Read them. Raises DataError naming file and key."""
        with h5.opened(self.folder / MATCHES) as file:
            points = h5.numbers(file, self.key, None, 4)
        ratios = None
        if (self.folder / RATIOS).exists():
            with h5.opened(self.folder / RATIOS) as file:
                ratios = h5.numbers(file, self.key).reshape(-1)
            if len(ratios) != len(points):
                raise DataError(
                    f"{self.folder / RATIOS}: {self.key!r} has {len(ratios)} entries, "
                    f"but {MATCHES} has {len(points)} matches of that pair"
                )
        return given(points[:, :2], points[:, 2:], self.sizes, (len(points), len(points)), ratio=ratios)


def tutorial_files(root: Path) -> list[Path]:
    """All that defines the data set."""
    names = (MATCHES, RATIOS, CALIBRATIONS, ROTATIONS, TRANSLATIONS, TRUTH)
    return [path for folder in scenes(root) for name in names if (path := folder / name).exists()]


def tutorial_pairs(root: Path, images: Path | None) -> Iterator[ImagePair]:
    """The pairs of every scene; of each file one opening, and one computation of F."""
    for folder in scenes(root):
        with h5.opened(folder / MATCHES) as file:
            names = h5.keys(file)
        with contextlib.ExitStack() as files:
            cameras = _Cameras(folder, files)
            pairs = [_pair(root, folder, key, cameras, images) for key in names]
        yield from with_fundamentals(pairs) if cameras.by_image else pairs


def scenes(root: Path) -> list[Path]:
    """The folders that hold matches: root itself, or those below it."""
    folders = [root] if (root / MATCHES).is_file() else sorted(path.parent for path in root.glob(f"*/{MATCHES}"))
    if not folders:
        raise DataError(f"{root}: neither {MATCHES} nor a sub-folder that holds one")
    return folders


class _Cameras:
    """What a scene's files say of its cameras; files: closes those that are read pair by pair."""

    def __init__(self, folder: Path, files: contextlib.ExitStack) -> None:
        self.folder = folder
        self._files, self._open = files, dict[str, Any]()
        self._images: dict[str, ImageSource] = {}
        self.by_image: dict[str, tuple[Array, Array]] = {}
        self.problems: dict[str, str] = {}
        rotations, translations = folder / ROTATIONS, folder / TRANSLATIONS
        if rotations.exists() and translations.exists():
            with h5.opened(rotations) as R, h5.opened(translations) as T:
                for name in h5.keys(R):
                    try:
                        self.by_image[name] = h5.reshaped(R, name, 3, 3), h5.reshaped(T, name, 3)
                    except DataError as error:
                        self.problems[name] = str(error)
        self._known = {*self.by_image, *self.problems}

    def image(self, family: str, name: str, images: Path | None) -> ImageSource:
        """An image of the scene, the same object for all pairs that show it."""
        if name not in self._images:
            self._images[name] = image(family, self.folder.name, name, images)
        return self._images[name]

    def split(self, key: str) -> tuple[str, str]:
        """The two images of a pair; their names may hold hyphens too."""
        parts = key.split("-")
        ways = [("-".join(parts[:i]), "-".join(parts[i:])) for i in range(1, len(parts))]
        for a, b in ways:
            if a in self._known and b in self._known:
                return a, b
        if len(ways) == 1 and not self._known:
            return ways[0]
        lack = f"names no two images of {ROTATIONS} and {TRANSLATIONS}" if self._known else "does not name two images"
        raise DataError(f"{self.folder / MATCHES}: {key!r} {lack}")

    def calibration(self, key: str) -> tuple[Array, Array]:
        K = h5.reshaped(self._file(CALIBRATIONS), key, 2, 3, 3)
        if not np.linalg.det(K).all():
            raise DataError(f"{self.folder / CALIBRATIONS}: {key!r}: a calibration matrix is singular")
        return K[0], K[1]

    def truth(self, key: str) -> Array:
        if not (self.folder / TRUTH).exists():
            raise DataError(
                f"{self.folder}: neither {ROTATIONS} and {TRANSLATIONS} nor {TRUTH}: the test split has no ground truth"
            )
        return h5.reshaped(self._file(TRUTH), key, 3, 3)

    def _file(self, name: str) -> Any:
        """A file of the scene, opened once: opening takes longer than reading a pair, and grows with the file."""
        if name not in self._open:
            self._open[name] = self._files.enter_context(h5.opened(self.folder / name))
        return self._open[name]


def _size(source: ImageSource, K: Array, images: Path | None) -> Size:
    """(h, w) of an image, by its principal point where there is no file. Raises DataError where the two disagree."""
    by_centre, size = size_by_centre(K), stored_size(source.path) if images else None
    if size is not None:
        expect_size(source, size, K)
    return size or by_centre


def _pair(root: Path, folder: Path, key: str, cameras: _Cameras, images: Path | None) -> ImagePair:
    family, scene = root.name, folder.name
    identity = key if folder == root else f"{scene}/{key}"  # whatever the folder is called: draws follow from it
    sources: tuple[ImageSource, ImageSource] | None = None
    try:
        name0, name1 = cameras.split(key)
        sources = cameras.image(family, name0, images), cameras.image(family, name1, images)
        for name in (name0, name1):
            if name in cameras.problems:
                raise DataError(cameras.problems[name])
        K0, K1 = cameras.calibration(key)
        sizes = _size(sources[0], K0, images), _size(sources[1], K1, images)
        if cameras.by_image:
            (R0, t0), (R1, t1) = cameras.by_image[name0], cameras.by_image[name1]
            R = R1 @ R0.T
            matches = TutorialMatches(folder, key, sizes)
            return posed(identity, family, scene, sources, (K0, K1), R, t1 - R @ t0, matches)
        F = cameras.truth(key)
        norm = float(np.linalg.norm(F))
        problem = None if norm else f"{folder / TRUTH}: {key!r} is zero"
        pair = ImagePair(identity, family, scene, *sources, F / (norm or 1.0), K0, K1, problem=problem)
    except DataError as error:
        unnamed = image(family, scene, key, images)
        return broken(identity, family, scene, sources or (unnamed, unnamed), str(error))
    return dataclasses.replace(pair, matches=TutorialMatches(folder, key, sizes))


# PoseBench's files of relative poses: a group for each pair, with ``x1``, ``x2`` (n, 2), ``camera1``, ``camera2``
# (``model``, ``width``, ``height``, ``params``), ``R`` (3, 3) and ``t`` (3,), X2 = R X1 + t


FOCAL_LENGTHS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}
"""Camera models that are pinholes where their distortion is zero, and how many focal lengths begin their parameters."""


@dataclasses.dataclass(frozen=True)
class PoseBenchMatches:
    """The matches of one pair. K: of both cameras. sizes: None where neither file nor image tells."""

    path: Path
    key: str
    K: tuple[Array, Array]
    sizes: tuple[Size | None, Size | None]

    def __call__(self) -> GivenMatches:
        """Read them. Raises DataError naming file and key."""
        with h5.opened(self.path) as file:
            x0, x1 = (h5.numbers(file, f"{self.key}/{name}", None, 2) for name in ("x1", "x2"))
        if len(x0) != len(x1):
            raise DataError(f"{self.path}: {self.key!r} has {len(x0)} points in x1 and {len(x1)} in x2")
        size0, size1 = (
            size_by_points(K, x) if size is None else size
            for size, K, x in zip(self.sizes, self.K, (x0, x1), strict=True)
        )
        return given(x0, x1, (size0, size1), (len(x0), len(x1)))


def posebench_pairs(root: Path, images: Path | None) -> Iterator[ImagePair]:
    """The pairs of a file, or of all files of a folder."""
    for path in h5.files(root):
        with h5.opened(path) as file:
            for key in h5.keys(file):
                yield _posebench_pair(file, path, root.stem, key, images)


def _posebench_pair(file: Any, path: Path, family: str, key: str, images: Path | None) -> ImagePair:
    scene, identity = path.stem, f"{path.stem}/{key}"
    sources = image(family, scene, f"{key}/1", images), image(family, scene, f"{key}/2", images)
    try:
        (K0, size0), (K1, size1) = (
            _camera(file, path, f"{key}/{name}", source)
            for name, source in zip(("camera1", "camera2"), sources, strict=True)
        )
        R, t = h5.reshaped(file, f"{key}/R", 3, 3), h5.reshaped(file, f"{key}/t", 3)
    except DataError as error:
        return broken(identity, family, scene, sources, str(error))
    pair = calibrated(identity, family, scene, sources, (K0, K1), R, t)
    return dataclasses.replace(pair, matches=PoseBenchMatches(path, key, (K0, K1), (size0, size1)))


def _camera(file: Any, path: Path, key: str, source: ImageSource) -> tuple[Array, Size | None]:
    """Calibration matrix, and size where the file or the image tells it."""
    model = h5.text(file, f"{key}/model")
    parameters = h5.numbers(file, f"{key}/params").reshape(-1)
    count = FOCAL_LENGTHS.get(model)
    if count is None:
        raise DataError(f"{path}: {key + '/model'!r} is {model}; it must be one of {', '.join(FOCAL_LENGTHS)}")
    if len(parameters) < count + 2 or not np.isfinite(parameters).all():
        raise DataError(f"{path}: {key + '/params'!r} holds {parameters}, which are no parameters of {model}")
    if parameters[count + 2 :].any():
        raise DataError(f"{path}: {key + '/params'!r} of {model} has distortion; F needs undistorted points")
    fx, fy = (parameters[0], parameters[count - 1])
    cx, cy = parameters[count : count + 2]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    sides = [_side(file, f"{key}/{name}") for name in ("height", "width")]
    if all(sides):
        return K, (sides[0], sides[1])
    size = stored_size(source.path)
    if size is not None:
        expect_size(source, size, K)
    return K, size


def _side(file: Any, key: str) -> int:
    """A side of an image in pixels, 0 where it is not known: some of PoseBench's cameras have none."""
    return max(0, int(h5.reshaped(file, key, 1)[0])) if h5.holds(file, key) else 0


# The files that OANet trains and tests on (Zhang et al., ICCV 2019), of one entry for each pair ``0``, ``1``, ...:


@dataclasses.dataclass(frozen=True, eq=False)
class OANetMatches:
    """The matches of one pair; K: its calibrations."""

    path: Path
    key: str
    K: tuple[Array, Array]
    sizes: tuple[Size, Size]

    def __call__(self) -> GivenMatches:
        """Read them, in pixels. Raises DataError naming file and key."""
        with h5.opened(self.path) as file:
            rays = h5.numbers(file, f"xs/{self.key}", 1, None, 4)[0]
            ratios, mutuals = (self._side(file, name, len(rays)) for name in ("ratios", "mutuals"))
        x0, x1 = (x * K.diagonal()[:2] + K[:2, 2] for x, K in zip((rays[:, :2], rays[:, 2:]), self.K, strict=True))
        return given(
            x0,
            x1,
            self.sizes,
            (len(rays), len(rays)),
            ratio=ratios,
            mutual=None if mutuals is None else mutuals.astype(bool),
        )

    def _side(self, file: Any, name: str, count: int) -> Array | None:
        if not h5.holds(file, name):
            return None
        values = h5.numbers(file, f"{name}/{self.key}").reshape(-1)
        if len(values) != count:
            raise DataError(
                f"{self.path}: {f'{name}/{self.key}'!r} has {len(values)} entries, "
                f"but {f'xs/{self.key}'!r} has {count} matches"
            )
        return values


def oanet_pairs(root: Path, images: Path | None) -> Iterator[ImagePair]:
    """The pairs of a file, or of all files of a folder."""
    for path in h5.files(root):
        with h5.opened(path) as file:
            if not h5.holds(file, "xs"):
                raise DataError(f"{path}: 'xs' is missing; it is no file of OANet's layout")
            for key in sorted(h5.keys(file["xs"]), key=lambda key: (len(key), key)):
                yield _oanet_pair(file, path, root.stem, key, images)


def _oanet_pair(file: Any, path: Path, family: str, key: str, images: Path | None) -> ImagePair:
    scene, identity = path.stem, f"{path.stem}/{key}"
    sources = image(family, scene, f"{key}/1", images), image(family, scene, f"{key}/2", images)
    try:
        K = _calibration(file, key, 1), _calibration(file, key, 2)
        R, t = h5.reshaped(file, f"Rs/{key}", 3, 3), h5.reshaped(file, f"ts/{key}", 3)
        sizes = size_by_centre(K[0]), size_by_centre(K[1])
    except DataError as error:
        return broken(identity, family, scene, sources, str(error))
    pair = calibrated(identity, family, scene, sources, K, R, t)
    return dataclasses.replace(pair, matches=OANetMatches(path, key, K, sizes))


def _calibration(file: Any, key: str, which: int) -> Array:
    cx, cy = (h5.reshaped(file, f"{name}{which}s/{key}", 1)[0] for name in ("cx", "cy"))
    fx, fy = h5.reshaped(file, f"f{which}s/{key}", 2)
    if fx == 0 or fy == 0:
        raise DataError(f"{file.filename}: 'f{which}s/{key}' holds a focal length of zero")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
