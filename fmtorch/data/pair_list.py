"""Lists of image pairs on which others evaluate, such as MegaDepth-1500 and ScanNet-1500, with a folder of images."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmtorch.data.cameras import Camera, Matrix, fundamental, nearest_rotation
from fmtorch.data.image_sizes import stored_size
from fmtorch.data.listed_pairs import ListedPair, text_pairs
from fmtorch.data.pairs import ImagePair, ImageSource, PairDataset
from fmtorch.data.resampling import Resampling, Size, longer_side
from fmtorch.data.scene_npz import camera_files, npz_pairs
from fmtorch.data.text_files import DataError, given_root, numbered

TEXT_SUFFIXES, NPZ = (".txt", ".csv", ".list", ""), ".npz"
_FRAME = re.compile(r"(.+?)_frame\W")  # scene0711_00_frame-001680.jpg


class PairList(PairDataset):
    """The pairs of a list, whose images lie in a folder.

    Args:
        root: the folder of the images, to which the names of the list are relative.
        file: a text list of SuperGlue's or glue-factory's columns (`fmtorch.data.listed_pairs`); an ``.npz`` of LoFTR's
            (`fmtorch.data.scene_npz`); or a text file with the name of such an ``.npz`` in each line.
        resize: what images are resized to when read, px: one number for the longer side, [width, height] for both;
            None: not at all, but for lists of ScanNet whose K are of 640 x 480. K follows.
        origin: where the list's K puts the centre of the first pixel; None: 0.5 for glue-factory's lists and for
            MegaDepth's ``.npz``, otherwise 0.

    A pair's family is the list, its scene the first folder in which the names of the list differ. A pair with a missing
    image or without a sound camera has a `problem`. Raises DataError, naming file and line, for a list that cannot be
    read.
    """

    name = "pair_list"

    def __init__(
        self,
        root: str | Path | None = None,
        file: str | Path | None = None,
        resize: int | Sequence[int] | None = None,
        origin: float | None = None,
    ) -> None:
        home = given_root(root, "pair_list", "the folder of the images of dataset.file, the list")
        if file is None:
            raise DataError("pair_list needs file: dataset.file=FILE, the list of pairs, .txt or .npz")
        path = Path(file).expanduser()
        if not home.is_dir():
            raise DataError(f"{home}: no such folder; dataset.root must be the folder of the images")
        if not path.is_file():
            raise DataError(f"{path}: no such file; dataset.file must be the list of pairs")
        self._home, self._family, self._resize = home, path.stem, _resize(resize)
        listed, files = _listed(path, home)
        if not listed:
            raise DataError(f"{path}: holds no pairs")
        self._origin = origin
        self._sizes: dict[Path, Size | None] = {}
        self._seen: Counter[str] = Counter()
        scenes = _scenes([name for pair in listed for name in pair.names], path.stem)
        self._pairs = [self._pair(pair, scenes[pair.names[0]]) for pair in listed]
        digest = hashlib.blake2b(repr((self._resize, self._origin)).encode(), digest_size=16)
        for name, each in files:
            content = each.read_bytes()
            digest.update(f"{name}:{len(content)}:".encode() + content)
        self.digest = digest.hexdigest()

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> ImagePair:
        return self._pairs[index]

    def _pair(self, listed: ListedPair, scene: str) -> ImagePair:
        identity = f"{self.name}/{listed.names[0]}-{listed.names[1]}"  # draws do not follow the name of the list
        self._seen[identity] += 1
        if self._seen[identity] > 1:  # the same pair on a second line is a second pair
            identity += f"#{self._seen[identity]}"
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
            target = longer_side(own, target)
        return ImageSource(identity, path, own, resampling=Resampling(target, turns))

    def _size(self, path: Path) -> Size | None:
        """(h, w) of an image, read once; None where it has no header."""
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
    return nearest_rotation(listed.R, listed.place), listed.t


def _listed(path: Path, home: Path) -> tuple[list[ListedPair], list[tuple[str, Path]]]:
    """The pairs of a list, and the files that define them, by their names."""
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
        pairs, own = _listed(member, home)
        listed, files = [*listed, *pairs], [*files, *own]
    return listed, files


def _resize(resize: int | Sequence[int] | None) -> int | Size | None:
    """Checked, [width, height] as (h, w)."""
    values = [resize] if isinstance(resize, int) else list(resize or [])
    if resize is None or (len(values) in (1, 2) and all(isinstance(v, int) and v > 0 for v in values)):
        return None if resize is None else values[0] if len(values) == 1 else (values[1], values[0])
    raise DataError(f"resize={resize}; it must be one length of the longer side, or [width, height], in pixels")


def _scenes(names: Sequence[str], family: str) -> dict[str, str]:
    """The scene of each image: the first folder in which the names differ, or what stands before ``_frame``."""
    folders = {name: Path(name).parts[:-1] for name in names}
    shared = 0
    for parts in zip(*folders.values(), strict=False):
        if len(set(parts)) > 1:
            break
        shared += 1
    scenes = {}
    for name, parts in folders.items():
        frame = _FRAME.match(Path(name).name)
        scenes[name] = parts[shared] if len(parts) > shared else frame[1] if frame else family
    return scenes
