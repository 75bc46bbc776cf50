"""Videos with known poses: KITTI odometry (Geiger et al., CVPR 2012) and TUM RGB-D (Sturm et al., IROS 2012)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fmtorch.core.lenses import Lens
from fmtorch.data import scenes
from fmtorch.data.files import DataError, Mask, Matrix, given_root, images_by_stem, numbered, to_finite
from fmtorch.data.pairs import ImageSource, nearest_rotation
from fmtorch.data.scenes import WINDOW, Scene, ScenePairs, View, following

_SUFFIXES = (".png", ".jpg")
_LAYOUT = "the layout is sequences/NN/calib.txt, times.txt, image_0/ and poses/NN.txt"
_POSE = "3 x 4 numbers of [R | t], row by row, from camera 0 to the world"
_PROJECTION = "P0: to P3: with 3 x 4 numbers each, row by row"


class KittiPairs(ScenePairs):
    """Pairs of frames at most `window` seconds apart of the odometry sequences.

    root: the folder with ``sequences`` and ``poses``. split: test (06-10) or train (00-05), as in the paper.
    sequences: names to take instead of those of the split. camera: 0 to 3, whose images ``image_N`` are taken.
    pairs, seed: as in `ScenePairs`.

    The images are rectified; cameras are ``P_N [R | t]^-1``. Raises DataError, naming file and line, for bad files."""

    def __init__(
        self, root: str | Path | None = None, split: str = "test", sequences: Sequence[str] | None = None,
        camera: Literal[0, 1, 2, 3] = 0, window: int | float = WINDOW, pairs: int | None = 1000, seed: int = 0,
    ) -> None:  # fmt: skip
        home = given_root(root, "kitti", "the folder with sequences/ and poses/ of KITTI odometry")
        there = sorted(f.name for f in (home / "sequences").iterdir()) if (home / "sequences").is_dir() else []
        names = scenes.chosen("kitti", split, sequences, there)
        folders = scenes.folders(home / "sequences", names, "a folder for each sequence")
        read = [_kitti_scene(home, folder, camera, window) for folder in folders]
        files = [(f.name, f / name) for f in folders for name in ("calib.txt", "times.txt")]
        poses = [(f.name, home / "poses" / f"{f.name}.txt") for f in folders]
        super().__init__("kitti", read, [*files, *poses], (camera, window), pairs, seed)


def _kitti_scene(home: Path, folder: Path, camera: int, window: int | float) -> Scene:
    name, images = folder.name, folder / f"image_{camera}"
    calibration, stamps = folder / "calib.txt", folder / "times.txt"
    projections, times = dict[str, Matrix](), list[float]()
    for number, line in numbered(calibration, _LAYOUT):
        key, _, rest = line.partition(":")
        projections[key.strip()] = to_finite(calibration, number, rest.split(), _PROJECTION, 12).reshape(3, 4)
    if f"P{camera}" not in projections:
        raise DataError(f"{calibration}: no line P{camera}; it must hold {_PROJECTION}")
    for number, line in numbered(stamps, _LAYOUT):
        (time,) = to_finite(stamps, number, line.split(), "seconds", 1).tolist()
        if times and time <= times[-1]:
            between = f"{time:g} s does not come after {times[-1]:g} s"
            raise DataError(f"{stamps}, line {number}: {between}; times must ascend")
        times.append(time)
    poses = home / "poses" / f"{name}.txt"
    lines = list(numbered(poses, _LAYOUT))
    if len(lines) != len(times):
        ends = f"{poses} ends at line {len(lines)} and {stamps} at line {len(times)}"
        raise DataError(f"{ends}; each must have one line a frame: is one of them truncated?")
    if not images.is_dir():
        raise DataError(f"{images}: no such folder; {_LAYOUT}")
    there = images_by_stem(images, _SUFFIXES)
    if len(there) > len(lines):
        ends = f"{poses} ends at line {len(lines)} and {images} has {len(there)} images"
        raise DataError(f"{ends}; each must have its line: is the file truncated?")
    views, P = [], projections[f"P{camera}"]  # K [I | K^-1 p4]
    for frame, (number, line) in enumerate(lines):
        place = f"{poses}, line {number}"
        pose = to_finite(poses, number, line.split(), _POSE, 12).reshape(3, 4)
        R = nearest_rotation(pose[:, :3].T, place)
        t = -R @ pose[:, 3] + np.linalg.solve(P[:, :3], P[:, 3])
        stem = f"{frame:06d}"
        path = there.get(stem, images / f"{stem}{_SUFFIXES[0]}")
        views.append(View(P[:, :3], R, t, ImageSource(f"KITTI/{name}/image_{camera}/{stem}", path), place))
    return Scene(name, "KITTI", views, following(times, window))


SIZE = (480, 640)  # h, w of all images
CALIBRATIONS = {  # colour cameras, as the set's page has them for OpenCV; freiburg3's images are undistorted
    "freiburg1": Lens(517.3, 516.5, 318.6, 255.3, "FULL_OPENCV", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0, 0, 0)),
    "freiburg2": Lens(520.9, 521.0, 325.1, 249.7, "FULL_OPENCV", (0.2312, -0.7849, -0.0033, -0.0001, 0.9172, 0, 0, 0)),
    "freiburg3": Lens(535.4, 539.2, 320.1, 247.6),
}
TOLERANCE = 0.02  # s between a frame and the poses around it, or its depth image: that of the set's own tools
DEPTH_SCALE = 5000.0  # of a depth image, per metre

_TUM_LAYOUT = "a sequence holds rgb.txt, groundtruth.txt and rgb/"
_LISTED = "timestamp filename"
_TUM_POSE = "timestamp tx ty tz qx qy qz qw"


def tum_pairs(
    root: str | Path | None = None, split: str = "test", sequences: Sequence[str] | None = None,
    camera: str | None = None, window: int | float = WINDOW, pairs: int | None = 1000, seed: int = 0,
    depth: bool = True,
) -> ScenePairs:  # fmt: skip
    """Pairs of frames at most `window` seconds apart.

    Args:
        root: the folder of the sequences' folders.
        split: test (fr3/teddy, fr3/large_cabinet, fr3/long_office_household) or train (all others there), as the paper.
        sequences: names of folders to take instead.
        camera: freiburg1, freiburg2 or freiburg3; None: as the name of each sequence says.
        pairs, seed: as in `ScenePairs`.
        depth: know the depth of points in metres, for labels, where every sequence has ``depth.txt``.

    The images of freiburg1 and freiburg2 are undistorted when they are read; those of freiburg3 are so already. The
    pose of a frame is interpolated between the two around it (linearly, and along the great circle); frames farther
    than `TOLERANCE` from either are left out. Raises DataError, naming file and line, for damaged files."""
    home = given_root(root, "tum", "the folder of the sequences' folders of TUM RGB-D")
    there = sorted(f.parent.name for f in home.glob("*/groundtruth.txt") if (f.parent / "rgb.txt").is_file())
    folders = scenes.folders(home, scenes.chosen("tum", split, sequences, there), "a folder for each sequence")
    read = [_tum_scene(folder, _lens(folder, camera), window) for folder in folders]
    files = [(folder.name, folder / name) for folder in folders for name in ("rgb.txt", "groundtruth.txt")]
    if not depth or not all((folder / "depth.txt").is_file() for folder in folders):
        return ScenePairs("tum", read, files, (window,), pairs, seed)
    files += [(folder.name, folder / "depth.txt") for folder in folders]
    paths = [_depth_paths(folder, scene) for folder, scene in zip(folders, read, strict=True)]
    depth_images = scenes.DepthImages(paths, DEPTH_SCALE, scenes.read_grey)
    return ScenePairs("tum", read, files, (window,), pairs, seed, depth_images.at)


def read_listed(path: Path) -> tuple[Matrix, list[str], list[int]]:
    """Time stamps (n,) in seconds, file names and line numbers of an ``rgb.txt`` or ``depth.txt``."""
    times, names, lines = list[float](), list[str](), list[int]()
    for number, line in numbered(path, _TUM_LAYOUT):
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise DataError(f"{path}, line {number}: {len(words)} columns; it must hold {_LISTED}")
        times.append(_time(path, number, words[0], times, _LISTED))
        names.append(words[1].strip())
        lines.append(number)
    if not times:
        raise DataError(f"{path}: no line with {_LISTED}")
    return np.array(times), names, lines


def read_trajectory(path: Path) -> tuple[Matrix, Matrix, Rotation]:
    """Times (n,) in seconds, positions (n, 3) and orientations of a ``groundtruth.txt``, camera to world."""
    times, poses = list[float](), list[Matrix]()
    for number, line in numbered(path, _TUM_LAYOUT):
        words = line.split()
        values = to_finite(path, number, words, _TUM_POSE, 8)
        if not values[4:].any():
            raise DataError(f"{path}, line {number}: the quaternion is zero; it must be a rotation")
        time = _time(path, number, words[0], times, _TUM_POSE)
        if not times or time > times[-1]:  # a repeated stamp adds nothing
            times.append(time)
            poses.append(values[1:])
    if len(times) < 2:
        raise DataError(f"{path}: {len(times)} poses; it must hold lines of {_TUM_POSE}")
    table = np.array(poses)
    return np.array(times), table[:, :3], Rotation.from_quat(table[:, 3:])


def interpolated(path: Path, wanted: Matrix) -> tuple[Mask, Matrix, Matrix]:
    """Which of the wanted times (n,) have a pose; of those rotations (m, 3, 3) and positions (m, 3), to the world."""
    times, positions, orientations = read_trajectory(path)
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    early, late = wanted - times[after - 1], times[after] - wanted
    has = (early >= 0) & (late >= 0) & (np.maximum(early, late) <= TOLERANCE)
    at = wanted[has]
    where = np.stack([np.interp(at, times, axis) for axis in positions.T], -1)
    return has, Slerp(times, orientations)(at).as_matrix().reshape(-1, 3, 3), where


def _time(path: Path, number: int, word: str, before: list[float], columns: str) -> float:
    (time,) = to_finite(path, number, [word], columns, 1)
    if before and time < before[-1]:
        raise DataError(f"{path}, line {number}: {word} comes after {before[-1]:.6f}; time stamps must ascend")
    return float(time)


def _lens(folder: Path, camera: str | None) -> Lens:
    names = [name for name in CALIBRATIONS if name == camera or (camera is None and name in folder.name)]
    if len(names) != 1:
        given = f"camera={camera}" if camera else f"{folder}: its name tells no camera"
        raise DataError(f"{given}; dataset.camera must be one of {', '.join(CALIBRATIONS)}")
    return CALIBRATIONS[names[0]]


def _tum_scene(folder: Path, lens: Lens, window: int | float) -> Scene:
    listed = folder / "rgb.txt"
    times, names, lines = read_listed(listed)
    has, rotations, positions = interpolated(folder / "groundtruth.txt", times)
    if not has.any():
        truth = folder / "groundtruth.txt"
        raise DataError(f"{truth}: no pose at the times of {listed.name}; is it another sequence's?")
    views = []
    for frame, to_world, position in zip(np.flatnonzero(has).tolist(), rotations, positions, strict=True):
        key = f"TUM/{folder.name}/{names[frame]}"
        source = ImageSource(key, folder / names[frame], SIZE, lens if lens.bends else None)
        views.append(View(lens.K, to_world.T, -to_world.T @ position, source, f"{listed}, line {lines[frame]}"))
    return Scene(folder.name, "TUM", views, following(times[has], window))


def _depth_paths(folder: Path, scene: Scene) -> dict[str, Path]:
    rgb = dict(zip(*read_listed(folder / "rgb.txt")[1::-1], strict=True))
    times, names, _ = read_listed(folder / "depth.txt")
    paths = {}
    for view in scene.views:
        time = rgb[str(view.image.path.relative_to(folder))]
        nearest = int(np.abs(times - time).argmin())
        if abs(times[nearest] - time) <= TOLERANCE:
            paths[view.image.identity] = folder / names[nearest]
    return paths
