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

from fmtorch.data.pairs import GivenMatches, ImagePair, ImageSource
from fmtorch.data.text_files import DataError
from fmtorch.storage.exchange import h5
from fmtorch.storage.exchange.given import (
    Array,
    Size,
    broken,
    expect_size,
    given,
    image,
    posed,
    size_by_centre,
    size_of,
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
        return given(points[:, :2], points[:, 2:], self.sizes, (len(points), len(points)), ratios)


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
    by_centre, size = size_by_centre(K), size_of(source) if images else None
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
