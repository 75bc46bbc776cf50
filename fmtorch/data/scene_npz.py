"""LoFTR's lists of image pairs (Sun et al., CVPR 2021): the ``.npz`` files of its MegaDepth-1500 and ScanNet-1500.

MegaDepth: a file a scene and range of overlap, with ``image_paths``, ``intrinsics``, ``poses`` (world to camera) by
image, and ``pair_infos``, whose entries begin with the two images; a text file may name several such files. ScanNet:
``name`` (n, 4), the numbers of scene, scan and both frames, perhaps ``rel_pose`` (n, 12), and ``intrinsics.npz`` beside
it with the K of images of 640 x 480 pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data.cameras import Camera, Matrix, relative_pose
from fmtorch.data.listed_pairs import CORNER, ListedPair
from fmtorch.data.object_arrays import NpzArrays
from fmtorch.data.text_files import DataError, read_numbers

DEPTH_SIZE = (480, 640)  # (h, w) of ScanNet's depth images, whose K intrinsics.npz holds
INTRINSICS = "intrinsics.npz"
_COLOUR = "intrinsic/intrinsic_color.txt"  # of a scene's folder: a matrix (4, 4), for the colour images' own size


def npz_pairs(path: Path, root: Path) -> Iterator[ListedPair]:
    """The pairs of one file. root: the folder of the images, in which ScanNet's cameras may lie too.

    Raises DataError for a file of another kind, and for arrays that do not fit.
    """
    arrays = NpzArrays(path)
    if "pair_infos" in arrays:
        yield from _megadepth(arrays)
    elif "name" in arrays:
        yield from _scannet(arrays, root)
    else:
        raise DataError(
            f"{path}: neither pair_infos (MegaDepth) nor name (ScanNet) among its arrays, {', '.join(arrays.names)}"
        )


def camera_files(path: Path, root: Path) -> list[tuple[str, Path]]:
    """The files that define the cameras of a list beside itself, by names that hold no place of theirs."""
    arrays, beside = NpzArrays(path), path.parent / INTRINSICS
    if "name" not in arrays or "pair_infos" in arrays:
        return []
    files = dict.fromkeys([] if beside.is_file() else [f"{scene}/{_COLOUR}" for scene, _, _ in _frames(arrays)])
    if "rel_pose" not in arrays:
        files |= dict.fromkeys(f"{scene}/pose/{frame}.txt" for scene, *frames in _frames(arrays) for frame in frames)
    own = [(name, root / name) for name in files if (root / name).is_file()]
    return [*([(INTRINSICS, beside)] if beside.is_file() else []), *own]


def _megadepth(arrays: NpzArrays) -> Iterator[ListedPair]:
    names, intrinsics, poses = arrays["image_paths"], arrays["intrinsics"], arrays["poses"]
    counts = {len(names), len(intrinsics), len(poses)}
    if len(counts) > 1:
        raise DataError(f"{arrays.path}: image_paths, intrinsics and poses must have one entry an image each")
    for record, info in enumerate(arrays["pair_infos"]):
        place = f"{arrays.path}, pair {record}"
        try:
            i, j = (int(index) for index in info[0])
        except (TypeError, ValueError, IndexError) as error:
            raise DataError(f"{place}: {info!r:.60}; it must begin with the numbers of two images") from error
        if not (min(i, j) >= 0 and max(i, j) < len(names)):
            raise DataError(f"{place}: images {i} and {j}; there are {len(names)}")
        (K0, T0), (K1, T1) = ((_matrix(intrinsics[k], 3), _matrix(poses[k], 4)) for k in (i, j))
        R, t = relative_pose(Camera(K0, T0[:3, :3], T0[:3, 3]), Camera(K1, T1[:3, :3], T1[:3, 3]))
        yield ListedPair(place, (str(names[i]), str(names[j])), K0, K1, R, t, origin=CORNER)


def _matrix(value: Any, size: int) -> Matrix:
    """A matrix (size, size) of an array of objects; NaN where there is none."""
    try:
        return np.asarray(value, np.float64).reshape(size, size)
    except (TypeError, ValueError):
        return np.full((size, size), np.nan)


def _scannet(arrays: NpzArrays, root: Path) -> Iterator[ListedPair]:
    frames = _frames(arrays)
    motions = arrays.get("rel_pose")
    if motions is not None and motions.shape not in ((len(frames), 12), (len(frames), 3, 4)):
        raise DataError(f"{arrays.path}: 'rel_pose' is {motions.shape}; it must be ({len(frames)}, 12)")
    beside = arrays.path.parent / INTRINSICS
    intrinsics = NpzArrays(beside) if beside.is_file() else None
    calibrations: dict[str, Matrix] = {}
    for record, (scene, first, second) in enumerate(frames):
        if scene not in calibrations:
            calibrations[scene] = _calibration(intrinsics, root, scene)
        K, place = calibrations[scene], f"{arrays.path}, pair {record}"
        names = f"{scene}/color/{first}.jpg", f"{scene}/color/{second}.jpg"
        if motions is None:
            R, t = relative_pose(*(_pose(root / scene / "pose" / f"{frame}.txt", K) for frame in (first, second)))
        else:
            motion = motions[record].reshape(3, 4).astype(np.float64)
            R, t = motion[:, :3], motion[:, 3]
        yield ListedPair(place, names, K, K, R, t, size=None if intrinsics is None else DEPTH_SIZE)


def _frames(arrays: NpzArrays) -> list[tuple[str, int, int]]:
    """Of each pair the name of its scene and the numbers of its frames."""
    names = arrays["name"]
    if names.ndim != 2 or names.shape[1] != 4 or names.dtype.kind not in "iu":
        raise DataError(f"{arrays.path}: 'name' is {names.dtype} {names.shape}; it must hold four whole numbers a pair")
    return [(f"scene{scene:04d}_{scan:02d}", first, second) for scene, scan, first, second in names.tolist()]


def _calibration(intrinsics: NpzArrays | None, root: Path, scene: str) -> Matrix:
    """K of a scene: of the file beside the list, or of the scene's own of the colour camera."""
    if intrinsics is not None:
        return _matrix(intrinsics[scene], 3)
    path = root / scene / _COLOUR
    if not path.is_file():
        raise DataError(
            f"{path}: no such file, nor {INTRINSICS} beside the list; one of them must hold the calibration"
        )
    return np.stack(read_numbers(path, "a matrix (4, 4)", 4))[:3, :3]


def _pose(path: Path, K: Matrix) -> Camera:
    """The camera of a pose file, a matrix (4, 4) from camera to world; NaN where there is none, or no finite one."""
    rows = read_numbers(path, "a matrix (4, 4), from camera to world", 4) if path.is_file() else []
    to_world = np.stack(rows) if len(rows) == 4 else np.full((4, 4), np.nan)
    if not np.isfinite(to_world).all():  # ScanNet has infinite poses
        return Camera(K, np.full((3, 3), np.nan), np.full(3, np.nan))
    R = to_world[:3, :3].T
    return Camera(K, R, -R @ to_world[:3, 3])
