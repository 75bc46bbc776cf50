"""Text lists of image pairs with cameras: SuperGlue's ``*_with_gt.txt`` and glue-factory's ``pairs_calibrated.txt``.

SuperGlue (Sarlin et al., CVPR 2020, match_pairs.py): the names of both images, by how many quarter turns each is turned
counterclockwise, K0, K1 row by row, and the pose, a matrix (4, 4) that takes points of camera 0 to camera 1. K and pose
are those of the images before they are turned. glue-factory: names, K0, K1, and either R and t or the matrix."""

import dataclasses
import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data import files, pairs
from fmtorch.data.files import DataError, Matrix, NpzArrays, given_root, numbered, read_numbers
from fmtorch.data.images import stored_size
from fmtorch.data.pairs import Camera, HeldPairs, ImagePair, ImageSource, Resampling, Size, fundamental, relative_pose

SUPERGLUE, GLUE_FACTORY, GLUE_FACTORY_4X4 = 38, 32, 36  # columns of a line
LAYOUTS = {
    SUPERGLUE: "name0 name1 turns0 turns1 K0 (9) K1 (9) pose (4 x 4), as SuperGlue",
    GLUE_FACTORY: "name0 name1 K0 (9) K1 (9) R (9) t (3), as glue-factory",
    GLUE_FACTORY_4X4: "name0 name1 K0 (9) K1 (9) pose (4 x 4), as glue-factory",
}
CORNER = 0.5  # where glue-factory and COLMAP, whose cameras MegaDepth's are, put the centre of the first pixel
_QUARTERS = 4  # of a full turn


@dataclasses.dataclass(frozen=True, eq=False)
class ListedPair:
    """One pair of a list.
    place: file and line, or record, with which messages begin. names: of the images, relative to their folder.
    K0, K1: (3, 3), for images of `size` (h, w), None: of the files' own sizes. R, t: ``X1 = R X0 + t``.
    quarter_turns: of both images, counterclockwise; K, R and t are those before the turn.
    origin: coordinates of the first pixel's centre in the convention of K."""

    place: str
    names: tuple[str, str]
    K0: Matrix
    K1: Matrix
    R: Matrix
    t: Matrix
    quarter_turns: tuple[int, int] = (0, 0)
    size: Size | None = None
    origin: float = 0.0


def text_pairs(path: Path) -> Iterator[ListedPair]:
    """The pairs of a text file, a line each; empty lines and comments (``#``) are left out.
    Raises DataError, naming the line, for a number of columns that is not one of `LAYOUTS`, and for an entry that is no
    number. Numbers that are not finite pass: they are one pair's fault."""
    for number, line in numbered(path):
        words = line.split()
        if len(words) not in LAYOUTS:
            forms = "; ".join(f"{count}: {form}" for count, form in LAYOUTS.items())
            without = " without cameras" if len(words) <= SUPERGLUE - GLUE_FACTORY else ""
            raise DataError(f"{path}, line {number}: {len(words)} columns{without}; it must have {forms}")
        names, values, turns, origin = (words[0], words[1]), words[2:], (0, 0), CORNER
        if len(words) == SUPERGLUE:
            turns, origin = (_turns(path, number, values[0]), _turns(path, number, values[1])), 0.0
            values = values[2:]
        cameras = files.to_numbers(path, number, values, "K0, K1 and the pose", len(values))
        K0, K1 = cameras[:18].reshape(2, 3, 3)
        yield ListedPair(f"{path}, line {number}", names, K0, K1, *_pose(cameras[18:]), turns, origin=origin)


def _turns(path: Path, number: int, word: str) -> int:
    turns = files.to_whole(path, number, word, "the number of quarter turns")
    if not 0 <= turns < _QUARTERS:
        raise DataError(f"{path}, line {number}: {turns} quarter turns; it must be 0, 1, 2 or 3")
    return turns


def _pose(values: Matrix) -> tuple[Matrix, Matrix]:
    if len(values) == 12:
        return values[:9].reshape(3, 3), values[9:]
    matrix = values.reshape(4, 4)
    return matrix[:3, :3], np.ascontiguousarray(matrix[:3, 3])


# LoFTR's lists of image pairs (Sun et al., CVPR 2021): the ``.npz`` files of its MegaDepth-1500 and ScanNet-1500

DEPTH_SIZE = (480, 640)  # (h, w) of ScanNet's depth images, whose K intrinsics.npz holds
INTRINSICS = "intrinsics.npz"
_COLOUR = "intrinsic/intrinsic_color.txt"  # of a scene's folder: a matrix (4, 4), for the colour images' own size


def npz_pairs(path: Path, root: Path) -> Iterator[ListedPair]:
    """The pairs of one file. root: the folder of the images, in which ScanNet's cameras may lie too.
    Raises DataError for a file of another kind, and for arrays that do not fit."""
    arrays = NpzArrays(path)
    if "pair_infos" in arrays:
        yield from _megadepth(arrays)
    elif "name" in arrays:
        yield from _scannet(arrays, root)
    else:
        there = ", ".join(arrays.names)
        raise DataError(f"{path}: neither pair_infos (MegaDepth) nor name (ScanNet) among its arrays, {there}")


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
    if len({len(names), len(intrinsics), len(poses)}) > 1:
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
    try:
        return np.asarray(value, np.float64).reshape(size, size)
    except (TypeError, ValueError):
        return np.full((size, size), np.nan)


def _scannet(arrays: NpzArrays, root: Path) -> Iterator[ListedPair]:
    frames = _frames(arrays)
    motions = arrays["rel_pose"] if "rel_pose" in arrays.names else None
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
            places = (root / scene / "pose" / f"{frame}.txt" for frame in (first, second))
            R, t = relative_pose(*(_pose_of_scene(file, K) for file in places))
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
        either = f"nor {INTRINSICS} beside the list; one of them must hold the calibration"
        raise DataError(f"{path}: no such file, {either}")
    return np.stack(read_numbers(path, "a matrix (4, 4)", 4))[:3, :3]


def _pose_of_scene(path: Path, K: Matrix) -> Camera:
    """The camera of a pose file, a matrix (4, 4) from camera to world; NaN where there is none, or no finite one."""
    rows = read_numbers(path, "a matrix (4, 4), from camera to world", 4) if path.is_file() else []
    to_world = np.stack(rows) if len(rows) == 4 else np.full((4, 4), np.nan)
    if not np.isfinite(to_world).all():  # ScanNet has infinite poses
        return Camera(K, np.full((3, 3), np.nan), np.full(3, np.nan))
    R = to_world[:3, :3].T
    return Camera(K, R, -R @ to_world[:3, 3])


TEXT_SUFFIXES, NPZ = (".txt", ".csv", ".list", ""), ".npz"
_FRAME = re.compile(r"(.+?)_frame\W")  # scene0711_00_frame-001680.jpg


class PairList(HeldPairs):
    """The pairs of a list, whose images lie in a folder.

    Args:
        root: the folder of the images, to which the names of the list are relative.
        file: a text list of SuperGlue's or glue-factory's columns; an ``.npz`` of LoFTR's; or a text file
            with the name of such an ``.npz`` in each line.
        resize: what images are resized to when read, px: one number for the longer side, [width, height] for both;
            None: not at all, but for lists of ScanNet whose K are of 640 x 480. K follows.
        origin: the first pixel's centre in K; None: 0.5 for glue-factory's lists and MegaDepth's ``.npz``, otherwise 0.

    A pair's family is the list, its scene the first folder in which the names of the list differ. A pair with a missing
    image or without a sound camera has a `problem`. Raises DataError, naming file and line, for other lists."""

    name = "pair_list"

    def __init__(
        self, root: str | Path | None = None, file: str | Path | None = None,
        resize: int | Sequence[int] | None = None, origin: float | None = None,
    ) -> None:  # fmt: skip
        home = given_root(root, "pair_list", "the folder of the images of dataset.file, the list")
        if file is None:
            raise DataError("pair_list needs file: dataset.file=FILE, the list of pairs, .txt or .npz")
        path = Path(file).expanduser()
        if not home.is_dir():
            raise DataError(f"{home}: no such folder; dataset.root must be the folder of the images")
        if not path.is_file():
            raise DataError(f"{path}: no such file; dataset.file must be the list of pairs")
        self._home, self._family, self._resize = home, path.stem, _resize(resize)
        listed, sources = _listed(path, home)
        if not listed:
            raise DataError(f"{path}: holds no pairs")
        self._origin = origin
        self._sizes: dict[Path, Size | None] = {}
        self._seen: Counter[str] = Counter()
        scenes = _scenes([name for pair in listed for name in pair.names], path.stem)
        self._pairs = [self._pair(pair, scenes[pair.names[0]]) for pair in listed]
        digest = hashlib.blake2b(repr((self._resize, self._origin)).encode(), digest_size=16)
        for name, source in sources:
            files.add_to_digest(digest, name, source)
        self.digest = digest.hexdigest()

    def _pair(self, listed: ListedPair, scene: str) -> ImagePair:
        identity = f"{self.name}/{listed.names[0]}-{listed.names[1]}"  # draws do not follow the name of the list
        identity = files.numbered_again(identity, self._seen)
        ends = list(zip(listed.names, (listed.K0, listed.K1), listed.quarter_turns, strict=True))
        images = [self._image(name, turns, listed.size) for name, _, turns in ends]
        pair = ImagePair(identity, self._family, scene, images[0], images[1], np.zeros((3, 3)))
        problems = [f"no image {image.path}" for image in images if not image.path.is_file()]
        try:
            K0, K1 = (self._camera(K, image, listed) for (_, K, _), image in zip(ends, images, strict=True))
            R, t = _motion(listed)
            before, after = ((image.resampling or Resampling()).rotation for image in images)
            R, t = after @ R @ before.T, after @ t
            F = fundamental(Camera(K0, np.eye(3), np.zeros(3)), Camera(K1, R, t))
            pair = dataclasses.replace(pair, F=F, K0=K0, K1=K1, R=R, t=t)
        except DataError as error:
            problems.append(str(error).removeprefix(f"{listed.place}: "))
        return dataclasses.replace(pair, problem=f"{listed.place}: {'; '.join(problems)}" if problems else None)

    def _image(self, name: str, turns: int, size: Size | None) -> ImageSource:
        """The image of a name as it is read. size: of the images that the list's K are of, where it says so."""
        path = self._home / name
        own = self._size(path) if self._resize is not None or turns or size is not None else None
        identity = f"{self.name}/{name}"
        if own is None:
            return ImageSource(identity, path)
        target = size if self._resize is None else self._resize
        if isinstance(target, int):
            target = pairs.scaled_size(own, target / max(own))
        return ImageSource(identity, path, own, resampling=Resampling(target, turns))

    def _size(self, path: Path) -> Size | None:
        if path not in self._sizes:
            self._sizes[path] = stored_size(path)
        return self._sizes[path]

    def _camera(self, K: Matrix, image: ImageSource, listed: ListedPair) -> Matrix:
        """The calibration of an image as it is read. Raises DataError where the list's is none."""
        if not np.isfinite(K).all() or abs(np.linalg.det(K)) == 0:
            raise DataError(f"{listed.place}: K is {K.ravel().tolist()}; it must be finite and invertible")
        K = K.copy()
        K[:2, 2] -= listed.origin if self._origin is None else self._origin
        if image.resampling is None:
            return K
        assert image.size is not None
        return image.resampling.calibration(K, listed.size or image.size)


def _motion(listed: ListedPair) -> tuple[Matrix, Matrix]:
    """R, the rotation nearest to the list's, and t. Raises DataError where there is no motion."""
    if not (np.isfinite(listed.R).all() and np.isfinite(listed.t).all()):
        raise DataError(f"{listed.place}: the pose is not finite")
    if not listed.t.any():
        raise DataError(f"{listed.place}: t is zero, the cameras did not move apart, which leaves no F")
    return pairs.nearest_rotation(listed.R, listed.place), listed.t


def _listed(path: Path, home: Path) -> tuple[list[ListedPair], list[tuple[str, Path]]]:
    if path.suffix == NPZ:
        return list(npz_pairs(path, home)), [(path.name, path), *camera_files(path, home)]
    if path.suffix not in TEXT_SUFFIXES:
        raise DataError(f"{path}: a list must be a text file (.txt) or an .npz; this one ends in {path.suffix}")
    lines = list(numbered(path))
    if not lines or not lines[0][1].strip().endswith(NPZ):
        return list(text_pairs(path)), [(path.name, path)]
    listed, files = list[ListedPair](), [(path.name, path)]
    for number, line in lines:
        member = path.parent / line.strip()
        if member.suffix != NPZ or not member.is_file():
            raise DataError(f"{path}, line {number}: no file {member}; each line must name an .npz beside the list")
        more, own = _listed(member, home)
        listed, files = [*listed, *more], [*files, *own]
    return listed, files


def _resize(resize: int | Sequence[int] | None) -> int | Size | None:
    if resize is None:
        return None
    values = [resize] if isinstance(resize, int) else list(resize)
    if len(values) in (1, 2) and all(isinstance(v, int) and v > 0 for v in values):
        return values[0] if len(values) == 1 else (values[1], values[0])
    raise DataError(f"resize={resize}; it must be one length of the longer side, or [width, height], in pixels")


def _scenes(names: Sequence[str], family: str) -> dict[str, str]:
    """The scene of each image: the first folder in which the names differ, or what stands before ``_frame``."""
    folders = {name: Path(name).parts[:-1] for name in names}
    shared = len(list(itertools.takewhile(lambda parts: len(set(parts)) == 1, zip(*folders.values(), strict=False))))
    scenes = {}
    for name, parts in folders.items():
        frame = _FRAME.match(Path(name).name)
        scenes[name] = parts[shared] if len(parts) > shared else frame[1] if frame else family
    return scenes
