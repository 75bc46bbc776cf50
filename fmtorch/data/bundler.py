"""Scenes reconstructed by Bundler (Snavely et al., SIGGRAPH 2006), as 1DSfM (Wilson and Snavely, ECCV 2014) has them.

Format: Bundler's manual, "Output format and scene representation", file version 0.3.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import nearest_rotation
from fmtorch.data.images import stored_size
from fmtorch.data.lenses import Lens
from fmtorch.data.pairs import ImageSource
from fmtorch.data.scenes import (
    MIN_SHARED,
    AllPairs,
    Candidates,
    Scene,
    ScenePairs,
    View,
    chosen,
    folders,
    sharing_points,
)
from fmtorch.data.text_files import DataError, given_root, numbered, read_lines, to_finite, to_whole

_FILES = ("gt_bundle.out", "bundle.out", "bundle/bundle.out")  # within a scene's folder, in the order they are tried
_LIST = "list.txt"
_HEADER = "# Bundle file v0.3"
_FLIP = np.diag([1.0, -1.0, -1.0])  # Bundler's y points up and its camera looks along -z
_LINES = 5  # a camera: f k1 k2, R in three lines, t
_COLUMNS = ("f k1 k2", "the first row of R", "the second row of R", "the third row of R", "t")


class BundlerPairs(ScenePairs):
    """Pairs of the images of Bundler files, one folder a scene.

    root: a folder of scenes, or one scene's folder, with ``list.txt`` and ``gt_bundle.out``, ``bundle.out`` or
    ``bundle/bundle.out``. split, sequences, candidates, shared, pairs, seed, family: as in `colmap_pairs`.

    Cameras without a focal length, which Bundler did not register, are left out. Radial distortion is taken out when an
    image is read. The principal point is the middle of each image, whose size is read from its file.
    """

    def __init__(
        self,
        root: str | Path | None = None,
        split: str = "test",
        sequences: Sequence[str] | None = None,
        candidates: Literal["all", "points"] = "all",
        shared: int = MIN_SHARED,
        pairs: int | None = 1000,
        seed: int = 0,
        family: str | None = None,
    ) -> None:
        home = given_root(
            root, "bundler", "a folder of scenes with list.txt and a Bundler file each, or one such scene"
        ).absolute()
        if sequences is None and (home / _LIST).is_file():
            home, sequences = home.parent, [home.name]
        scene_folders = folders(home, chosen("colmap", split, sequences, ()), f"a folder for each scene, with {_LIST}")
        files = [_bundle(folder) for folder in scene_folders]
        scenes = [
            _scene(folder, file, candidates, shared, family or home.name)
            for folder, file in zip(scene_folders, files, strict=True)
        ]
        sources = [(f.name, path) for f, file in zip(scene_folders, files, strict=True) for path in (file, f / _LIST)]
        super().__init__("bundler", scenes, sources, (candidates, shared, family or home.name), pairs, seed)
        self.points = [functools.partial(_points, file) for file in files]


def _bundle(folder: Path) -> Path:
    for name in _FILES:
        if (folder / name).is_file():
            return folder / name
    raise DataError(f"{folder}: no Bundler file; it must hold one of {', '.join(_FILES)}")


def _scene(folder: Path, file: Path, candidates: Literal["all", "points"], shared: int, family: str) -> Scene:
    names = [line.split()[0] for _, line in numbered(folder / _LIST)]  # a focal length may stand behind
    lines = read_lines(file)
    if not lines or lines[0].strip() != _HEADER:
        raise DataError(f"{file}, line 1: {lines[0][:40] if lines else ''!r}; it must be {_HEADER!r}")
    cameras, points = _counts(file, lines)
    if cameras != len(names):
        raise DataError(
            f"{file}, line 2: {cameras} cameras and {folder / _LIST} has {len(names)} images; both must agree"
        )
    end = 2 + _LINES * cameras + 3 * points
    if len(lines) < end:
        raise DataError(
            f"{file} ends at line {len(lines)}; {cameras} cameras and {points} points need {end}: truncated?"
        )
    views, numbers = list[View](), dict[int, int]()
    for i, name in enumerate(names):
        view = _view(file, lines, i, ImageSource(f"{family}/{folder.name}/{name}", folder / name))
        if view is not None:
            numbers[i] = len(views)
            views.append(view)
    if not views:
        raise DataError(f"{file}: no camera has a focal length; none was registered")
    pairs: Candidates = AllPairs(len(views))
    if candidates == "points":
        pairs = sharing_points(_seen(file, lines, cameras, points, numbers), shared)
    return Scene(folder.name, family, views, pairs)


def _points(file: Path) -> list[NDArray[np.int64]]:
    """The points that each registered camera of a file sees; the file was read before."""
    lines = read_lines(file)
    cameras, points = _counts(file, lines)
    registered = [i for i in range(cameras) if float(lines[2 + _LINES * i].split()[0]) != 0]
    return _seen(file, lines, cameras, points, {i: number for number, i in enumerate(registered)})


def _counts(file: Path, lines: list[str]) -> tuple[int, int]:
    words = lines[1].split() if len(lines) > 1 else []
    if len(words) != 2:
        raise DataError(f"{file}, line 2: {len(words)} columns; it must hold the numbers of cameras and of points")
    return to_whole(file, 2, words[0], "the number of cameras"), to_whole(file, 2, words[1], "the number of points")


def _view(file: Path, lines: list[str], i: int, source: ImageSource) -> View | None:
    """The view of camera i, if it was registered; an image that cannot be opened has a size that no pair will use."""
    first = 2 + _LINES * i
    rows = [to_finite(file, first + k + 1, lines[first + k].split(), _COLUMNS[k], 3) for k in range(_LINES)]
    focal, k1, k2 = (float(value) for value in rows[0])
    if focal == 0:
        return None
    place = f"{file}, line {first + 1}"
    if focal < 0:
        raise DataError(f"{place}: focal length {focal:g}; it must be positive")
    h, w = stored_size(source.path) or (1, 1)  # reading an image without a header tells
    lens = Lens(focal, focal, (w - 1) / 2, (h - 1) / 2, "RADIAL", (k1, k2))
    R = _FLIP @ nearest_rotation(np.stack(rows[1:4]), place)
    image = ImageSource(source.identity, source.path, (h, w), lens if lens.bends else None)
    return View(image, lens.K, R, _FLIP @ rows[4], place)


def _seen(file: Path, lines: list[str], cameras: int, points: int, numbers: dict[int, int]) -> list[NDArray[np.int64]]:
    """The points that each view sees."""
    seen: list[list[int]] = [[] for _ in numbers]
    for point in range(points):
        number = 2 + _LINES * cameras + 3 * point + 3  # of the line, from 1
        words = lines[number - 1].split()
        count = to_whole(file, number, words[0], "the length of the view list") if words else -1
        if len(words) != 1 + 4 * count:
            raise DataError(f"{file}, line {number}: {len(words)} columns; it must hold n and n times camera key x y")
        for word in words[1::4]:
            camera = to_whole(file, number, word, "the number of a camera")
            if camera in numbers:
                seen[numbers[camera]].append(point)
    return [np.array(indices, dtype=np.int64) for indices in seen]
