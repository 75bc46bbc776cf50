"""The layout of FM-Bench: pairs with their F, and photographs with a ``Camera.txt``, of which pairs are made."""

import dataclasses
import hashlib
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmtorch.data import files
from fmtorch.data.files import DataError, Matrix, given_root, images_by_stem, read_numbers
from fmtorch.data.pairs import Camera, HeldPairs, ImagePair, ImageSource, relative_pose
from fmtorch.data.scenes import WINDOW, AllPairs, Candidates, Scene, ScenePairs, View, folders, following

CAMERAS, IMAGES, SUFFIXES = "Camera.txt", "Images", (".jpg", ".png")
COLUMNS = "K (9 numbers, row by row), R (9), t (3)"


class CameraFilePairs(ScenePairs):
    """Pairs of images ``<scene>/Images/%08d.jpg`` (or .png), whose cameras are the lines of ``<scene>/Camera.txt``.
    root: a folder of scenes, or one scene's folder. sequences: names of scenes to take; None: all.
    fps: frames a second of videos, paired within `window` seconds; None: all pairs. pairs, seed: as in `ScenePairs`."""

    def __init__(
        self, root: str | Path | None = None, split: str = "test", sequences: Sequence[str] | None = None,
        fps: int | float | None = None, window: int | float = WINDOW, pairs: int | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        if split != "test":
            raise DataError(f"split {split!r}: cameras has only 'test'; choose scenes by root or sequences")
        if fps is not None and fps <= 0:
            raise DataError(f"fps={fps:g}; it must be positive, or null for images in no order")
        wanted = "a folder of scenes with Camera.txt and Images/ each, or one such scene"
        home = given_root(root, "cameras", wanted).absolute()
        if sequences is None and (home / CAMERAS).is_file():
            home, sequences = home.parent, [home.name]
        names = sequences or sorted(path.parent.name for path in home.glob(f"*/{CAMERAS}"))
        scene_folders = folders(home, names, f"a folder for each scene, with {CAMERAS} and {IMAGES}/")
        if not scene_folders:
            raise DataError(f"{home}: no folder with {CAMERAS}, one line an image: {COLUMNS}")
        scenes = [_scene(folder, fps, window) for folder in scene_folders]
        super().__init__("cameras", scenes, [(f.name, f / CAMERAS) for f in scene_folders], (fps, window), pairs, seed)


def _scene(folder: Path, fps: int | float | None, window: int | float) -> Scene:
    family = folder.parent.name
    images = folder / IMAGES
    if not images.is_dir():
        raise DataError(f"{images}: no such folder; it must hold the images of {folder / CAMERAS}")
    there = images_by_stem(images, SUFFIXES)
    views = list[View]()
    for number, line in files.numbered(folder / CAMERAS):
        stem, values = f"{len(views):08d}", files.to_finite(folder / CAMERAS, number, line.split(), COLUMNS, 21)
        source = ImageSource(f"{family}/{folder.name}/{stem}", there.get(stem, images / f"{stem}{SUFFIXES[0]}"))
        place = f"{folder / CAMERAS}, line {number}"
        views.append(View(values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:], source, place))
    count = len(views)
    pairs: Candidates = AllPairs(count) if fps is None else following(np.arange(count) / fps, window)
    return Scene(folder.name, family, views, pairs)


_PAIRS, _SUBSETS = "pairs_with_gt.txt", "pairs_which_dataset.txt"
_PAIR_COLUMNS = "l r F11 F12 F13 F21 F22 F23 F31 F32 F33"
_LAYOUT = f"the layout is <set>/{_PAIRS} and <set>/{_SUBSETS}"


class FMBenchPairs(HeldPairs):
    """The pairs of one or several sets in the authors' distribution layout.

    root: one set's folder, which holds ``pairs_with_gt.txt``, or a folder of such sets.
    split: the distribution holds test pairs only; a set for tuning has a root of its own.
    sets: names of the sets to take from a folder of several, in this order; all, by name, when not given.
    subset: names of the subsets (scenes) to take; all when not given.
    cameras: read ``<subset>/Camera.txt`` where it stands, for K, R and t.

    A pair's family is its set, its scene the subset, its identity ``<set>/<subset>/<l>-<r>``; image 0 is l.
    A line with a NaN, infinite or zero F or a missing image becomes a pair with a `problem`; whatever makes files as a
    whole unreliable raises DataError: a missing one, a wrong number of columns, different lengths, no number."""

    name = "fmbench"

    def __init__(
        self, root: str | Path | None = None, split: str = "test", subset: str | Sequence[str] | None = None,
        sets: Sequence[str] | None = None, cameras: bool = True,
    ) -> None:  # fmt: skip
        if split != "test":
            raise DataError(f"split {split!r}: the FM-Bench distribution has only 'test'; choose pairs by root or sets")
        self._subsets = None if subset is None else {subset} if isinstance(subset, str) else set(subset)
        self._cameras = cameras
        self._hash = hashlib.blake2b(digest_size=16)
        self._pairs: list[ImagePair] = []
        self._seen: Counter[str] = Counter()
        self._present: set[str] = set()
        home = given_root(root, "fmbench", "a set's folder with pairs_with_gt.txt, or a folder of such sets")
        for folder in _set_folders(home, sets):
            self._read_set(folder)
        for missing in sorted((self._subsets or set()) - self._present):
            there = ", ".join(sorted(self._present)) or "no pairs"
            raise DataError(f"{root}: no pairs of subset {missing!r}; it has {there}")
        self.digest = self._hash.hexdigest()

    def _read_set(self, folder: Path) -> None:
        table = read_numbers(folder / _PAIRS, _PAIR_COLUMNS, 11, _LAYOUT)
        scenes = [line.strip().replace("\\", "/").strip("/") for line in files.read_lines(folder / _SUBSETS, _LAYOUT)]
        if len(table) != len(scenes):
            raise DataError(
                f"{folder / _SUBSETS} has {len(scenes)} lines and {folder / _PAIRS} has {len(table)}; "
                "each must have one line a pair, in the same order"
            )
        self._present.update(scenes)
        for file in (_PAIRS, _SUBSETS):
            files.add_to_digest(self._hash, f"{folder.name}/{file}", folder / file)
        chosen = sorted(set(scenes) if self._subsets is None else set(scenes) & self._subsets)
        self._hash.update(repr(chosen).encode())
        images = {scene: _images(folder, scene) for scene in chosen}
        cameras = {scene: self._read_cameras(folder, scene) for scene in chosen}
        for number, (row, scene) in enumerate(zip(table, scenes, strict=True), start=1):
            if scene in images:
                line = f"{folder / _PAIRS}, line {number}"
                self._pairs.append(self._pair(line, folder, scene, row, images[scene], cameras[scene]))

    def _read_cameras(self, folder: Path, scene: str) -> list[Camera] | None:
        path = folder / scene / CAMERAS
        if not self._cameras or not path.is_file():
            return None
        files.add_to_digest(self._hash, f"{folder.name}/{scene}/{CAMERAS}", path)
        rows = read_numbers(path, f"{COLUMNS}; or give cameras=false to do without", 21)
        return [Camera(r[:9].reshape(3, 3), r[9:18].reshape(3, 3), r[18:]) for r in rows]

    def _pair(
        self, line: str, folder: Path, scene: str, row: Matrix, images: dict[str, Path], cameras: list[Camera] | None
    ) -> ImagePair:
        for value in row[:2]:
            if not (np.isfinite(value) and value >= 0 and value == int(value)):
                raise DataError(f"{line}: image number {value:g}; it must be a whole number from 0")
        left, right = map(int, row[:2])
        F, problems = _normalized(row[2:].reshape(3, 3))
        sources = list[ImageSource]()
        for stem in (f"{left:08d}", f"{right:08d}"):
            path = images.get(stem, folder / scene / IMAGES / f"{stem}{SUFFIXES[0]}")
            sources.append(ImageSource(f"{folder.name}/{scene}/{stem}", path))
            if stem not in images:
                problems.append(f"no image {path} (or {SUFFIXES[1]})")
        identity = files.numbered_again(f"{folder.name}/{scene}/{left}-{right}", self._seen)
        problem = f"{line}: {'; '.join(problems)}" if problems else None
        pair = ImagePair(identity, folder.name, scene, sources[0], sources[1], F, problem=problem)
        if cameras is None:
            return pair
        if max(left, right) >= len(cameras):
            raise DataError(
                f"{folder / scene / CAMERAS} has {len(cameras)} lines, but {line} names image {max(left, right)}; "
                "line i + 1 must be the camera of image i"
            )
        c0, c1 = cameras[left], cameras[right]
        R, t = relative_pose(c0, c1)
        return dataclasses.replace(pair, K0=c0.K, K1=c1.K, R=R, t=t)


def _normalized(F: Matrix) -> tuple[Matrix, list[str]]:
    """F with unit Frobenius norm, or zero and what is wrong with it."""
    largest = float(np.abs(F).max())
    if not np.isfinite(largest):
        return np.zeros((3, 3)), ["F has an entry that is not finite"]
    if largest == 0:
        return np.zeros((3, 3)), ["F is zero"]
    F = F / largest
    return F / np.linalg.norm(F), []


def _set_folders(root: Path, sets: Sequence[str] | None) -> list[Path]:
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; it must be a set's folder with {_PAIRS}, or a folder of such sets")
    root = Path(os.path.abspath(root))  # a link keeps its name
    candidates = [root] if (root / _PAIRS).is_file() else sorted(root.iterdir())
    folders = {folder.name: folder for folder in candidates if (folder / _PAIRS).is_file()}
    if not folders:
        raise DataError(f"{root}: neither {_PAIRS} nor a sub-folder that holds one")
    for name in sets or ():
        if name not in folders:
            raise DataError(f"{root}: no set {name!r}; it has {', '.join(sorted(folders))}")
    return [folders[name] for name in (sets or folders)]


def _images(folder: Path, scene: str) -> dict[str, Path]:
    images = folder / scene / IMAGES
    if not images.is_dir():
        raise DataError(f"{folder / _SUBSETS} names {scene}/, but there is no folder {images}")
    return images_by_stem(images, SUFFIXES)
