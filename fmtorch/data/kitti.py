"""KITTI odometry (Geiger et al., CVPR 2012): rectified driving videos with poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmtorch.data.cameras import Matrix, from_projection, nearest_rotation
from fmtorch.data.pairs import ImageSource
from fmtorch.data.scenes import WINDOW, Scene, ScenePairs, View, chosen, folders, following
from fmtorch.data.text_files import DataError, given_root, numbered, to_finite

_SUFFIXES = (".png", ".jpg")
_LAYOUT = "the layout is sequences/NN/calib.txt, times.txt, image_0/ and poses/NN.txt"
_POSE = "3 x 4 numbers of [R | t], row by row, from camera 0 to the world"
_PROJECTION = "P0: to P3: with 3 x 4 numbers each, row by row"


class KittiPairs(ScenePairs):
    """Pairs of frames at most `window` seconds apart of the odometry sequences.

    root: the folder with ``sequences`` and ``poses``. split: test (06-10) or train (00-05), as in the paper.
    sequences: names to take instead of those of the split. camera: 0 to 3, whose images ``image_N`` are taken.
    pairs, seed: as in `ScenePairs`.

    The images are rectified: nothing is undistorted. Cameras are ``P_N [R | t]^-1``. Raises DataError, naming file and
    line, for files that are missing, truncated or contradict one another.
    """

    def __init__(
        self,
        root: str | Path | None = None,
        split: str = "test",
        sequences: Sequence[str] | None = None,
        camera: int = 0,
        window: int | float = WINDOW,
        pairs: int | None = 1000,
        seed: int = 0,
    ) -> None:
        home = given_root(root, "kitti", "the folder with sequences/ and poses/ of KITTI odometry")
        there = sorted(f.name for f in (home / "sequences").iterdir()) if (home / "sequences").is_dir() else []
        sequence_folders = folders(
            home / "sequences", chosen("kitti", split, sequences, there), "a folder for each sequence"
        )
        scenes = [_scene(home, folder, camera, window) for folder in sequence_folders]
        files = [(f.name, f / name) for f in sequence_folders for name in ("calib.txt", "times.txt")]
        poses = [(f.name, home / "poses" / f"{f.name}.txt") for f in sequence_folders]
        super().__init__("kitti", scenes, [*files, *poses], (camera, window), pairs, seed)


def read_projections(path: Path) -> dict[str, Matrix]:
    """The matrices (3, 4) of a ``calib.txt`` by their names, P0 to P3; others, such as Tr, too."""
    projections = {}
    for number, line in numbered(path, _LAYOUT):
        name, _, rest = line.partition(":")
        projections[name.strip()] = to_finite(path, number, rest.split(), _PROJECTION, 12).reshape(3, 4)
    return projections


def read_times(path: Path) -> NDArray[np.float64]:
    """The seconds (n,) of a ``times.txt``; they must ascend."""
    times: list[float] = []
    for number, line in numbered(path, _LAYOUT):
        (time,) = to_finite(path, number, line.split(), "seconds", 1)
        if times and time <= times[-1]:
            raise DataError(f"{path}, line {number}: {time:g} s does not come after {times[-1]:g} s; times must ascend")
        times.append(float(time))
    return np.array(times)


def _scene(home: Path, folder: Path, camera: int, window: int | float) -> Scene:
    name, images = folder.name, folder / f"image_{camera}"
    projections = read_projections(folder / "calib.txt")
    if f"P{camera}" not in projections:
        raise DataError(f"{folder / 'calib.txt'}: no line P{camera}; it must hold {_PROJECTION}")
    times = read_times(folder / "times.txt")
    poses = home / "poses" / f"{name}.txt"
    lines = list(numbered(poses, _LAYOUT))
    if len(lines) != len(times):
        raise DataError(
            f"{poses} ends at line {len(lines)} and {folder / 'times.txt'} at line {len(times)}; each must have one "
            "line a frame: is one of them truncated?"
        )
    if not images.is_dir():
        raise DataError(f"{images}: no such folder; {_LAYOUT}")
    there = {file.stem: file for file in sorted(images.iterdir(), reverse=True) if file.suffix in _SUFFIXES}
    if len(there) > len(lines):
        raise DataError(
            f"{poses} ends at line {len(lines)} and {images} has {len(there)} images; each must have its line: is the "
            "file truncated?"
        )
    views = []
    for frame, (number, line) in enumerate(lines):
        place = f"{poses}, line {number}"
        pose = to_finite(poses, number, line.split(), _POSE, 12).reshape(3, 4)
        R = nearest_rotation(pose[:, :3].T, place)
        c = from_projection(projections[f"P{camera}"], R, -R @ pose[:, 3])
        stem = f"{frame:06d}"
        path = there.get(stem, images / f"{stem}{_SUFFIXES[0]}")
        views.append(View(ImageSource(f"KITTI/{name}/image_{camera}/{stem}", path), c.K, c.R, c.t, place))
    return Scene(name, "KITTI", views, following(times, window))
