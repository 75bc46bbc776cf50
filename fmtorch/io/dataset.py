"""The data set `h5`: pairs whose matches somebody else computed, in the layouts that the field exchanges."""

import contextlib
import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmtorch.data import DataError, FMBenchPairs, GivenMatches, ImagePair, ImageSource, Lens
from fmtorch.data.files import Matrix, given_root
from fmtorch.data.pairs import HeldPairs
from fmtorch.io import h5, oanet, predictions
from fmtorch.io.predictions import Images, Size

MATCHES, RATIOS, CALIBRATIONS, ROTATIONS, TRANSLATIONS, TRUTH = TUTORIAL = tuple(
    f"{name}.h5" for name in ("matches", "match_conf", "K1_K2", "R", "T", "Fgt")
)


def tutorial_matches(folder: Path, key: str, sizes: tuple[Size, Size]) -> GivenMatches:
    """The matches of one pair."""
    with h5.opened(folder / MATCHES) as file:
        points = h5.numbers(file, key, None, 4)
    ratios = None
    if (folder / RATIOS).exists():
        with h5.opened(folder / RATIOS) as file:
            ratios = h5.numbers(file, key).reshape(-1)
        if len(ratios) != len(points):
            lengths = f"{len(ratios)} entries, but {MATCHES} has {len(points)} matches of that pair"
            raise DataError(f"{folder / RATIOS}: {key!r} has {lengths}")
    return predictions.given(points[:, :2], points[:, 2:], sizes, (len(points), len(points)), ratio=ratios)


def tutorial_pairs(root: Path, images: Path | None) -> Iterator[ImagePair]:
    """The pairs of every scene; of each file one opening."""
    for folder in scenes(root):
        with h5.opened(folder / MATCHES) as file:
            names = h5.keys(file)
        with contextlib.ExitStack() as files:
            cameras = _Cameras(root.name, folder, images, files)
            yield from [_pair(root, folder, key, cameras, images) for key in names]


def scenes(root: Path) -> list[Path]:
    """The folders that hold matches: root itself, or those below it."""
    folders = [root] if (root / MATCHES).is_file() else sorted(path.parent for path in root.glob(f"*/{MATCHES}"))
    if not folders:
        raise DataError(f"{root}: neither {MATCHES} nor a sub-folder that holds one")
    return folders


class _Cameras:
    """What a scene's files say of its cameras; files: closes those that are read pair by pair.
    image: an image of the scene by its name, the same object for all pairs that show it."""

    def __init__(self, family: str, folder: Path, images: Path | None, files: contextlib.ExitStack) -> None:
        self.folder = folder
        # Opened once: opening takes longer than reading a pair, and grows with the file.
        self._file = functools.cache(lambda name: files.enter_context(h5.opened(folder / name)))
        self.image = functools.cache(functools.partial(predictions.image, family, folder.name, folder=images))
        self.by_image: dict[str, tuple[Matrix, Matrix]] = {}
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

    def calibration(self, key: str) -> tuple[Matrix, Matrix]:
        K = h5.reshaped(self._file(CALIBRATIONS), key, 2, 3, 3)
        if not np.linalg.det(K).all():
            raise DataError(f"{self.folder / CALIBRATIONS}: {key!r}: a calibration matrix is singular")
        return K[0], K[1]

    def truth(self, key: str) -> Matrix:
        if not (self.folder / TRUTH).exists():
            files = f"neither {ROTATIONS} and {TRANSLATIONS} nor {TRUTH}"
            raise DataError(f"{self.folder}: {files}: the test split has no ground truth")
        return h5.reshaped(self._file(TRUTH), key, 3, 3)


def _size(source: ImageSource, K: Matrix, images: Path | None) -> Size:
    """(h, w) of an image, by its principal point where there is no file. Raises DataError where the two disagree."""
    by_centre = predictions.size_by_centre(K)
    return (predictions.size_by_file(source, K) if images else None) or by_centre


def _pair(root: Path, folder: Path, key: str, cameras: _Cameras, images: Path | None) -> ImagePair:
    family, scene = root.name, folder.name
    identity = key if folder == root else f"{scene}/{key}"  # whatever the folder is called: draws follow from it
    sources: Images | None = None
    try:
        name0, name1 = cameras.split(key)
        sources = cameras.image(name0), cameras.image(name1)
        for name in (name0, name1):
            if name in cameras.problems:
                raise DataError(cameras.problems[name])
        K0, K1 = cameras.calibration(key)
        sizes = _size(sources[0], K0, images), _size(sources[1], K1, images)
        matches = functools.partial(tutorial_matches, folder, key, sizes)
        if cameras.by_image:
            (R0, t0), (R1, t1) = cameras.by_image[name0], cameras.by_image[name1]
            R = R1 @ R0.T
            pair = ImagePair(identity, family, scene, *sources, np.zeros((3, 3)), matches=matches)
            return predictions.with_cameras(pair, K0, K1, R, t1 - R @ t0)
        F = cameras.truth(key)
    except DataError as error:
        unnamed = predictions.image(family, scene, key, images)
        shown = sources or (unnamed, unnamed)
        return ImagePair(identity, family, scene, *shown, np.zeros((3, 3)), problem=str(error))
    norm = float(np.linalg.norm(F))
    problem = None if norm else f"{folder / TRUTH}: {key!r} is zero"
    return ImagePair(identity, family, scene, *sources, F / (norm or 1.0), K0, K1, problem=problem, matches=matches)


# PoseBench's files of relative poses: a group for each pair, with ``x1``, ``x2`` (n, 2), ``camera1``, ``camera2``
# (``model``, ``width``, ``height``, ``params``), ``R`` (3, 3) and ``t`` (3,), X2 = R X1 + t

FOCAL_LENGTHS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}
"""Camera models that are pinholes where their distortion is zero, and how many focal lengths begin their parameters."""


def posebench_matches(path: Path, key: str, K: tuple[Matrix, Matrix], sizes: Sequence[Size | None]) -> GivenMatches:
    """The matches of one pair. K: of both cameras. sizes: None where neither file nor image tells."""
    with h5.opened(path) as file:
        x0, x1 = (h5.numbers(file, f"{key}/{name}", None, 2) for name in ("x1", "x2"))
    if len(x0) != len(x1):
        raise DataError(f"{path}: {key!r} has {len(x0)} points in x1 and {len(x1)} in x2")
    known = zip(sizes, K, (x0, x1), strict=True)
    size0, size1 = (predictions.size_by_points(own, x) if size is None else size for size, own, x in known)
    return predictions.given(x0, x1, (size0, size1), (len(x0), len(x1)))


Stored = tuple[tuple[Matrix, Matrix], Matrix, Matrix, Callable[[], GivenMatches]]  # K of both images, R, t, matches
Read = Callable[[Any, Path, str, Images], Stored]


def _pairs(root: Path, images: Path | None, keys_of: Callable[[Any], list[str]], read: Read) -> Iterator[ImagePair]:
    """The pairs of a file, or of all files of a folder; read: what a file has under a key."""
    for path in h5.files(root):
        with h5.opened(path) as file:
            for key in keys_of(file):
                family, scene, identity = root.stem, path.stem, f"{path.stem}/{key}"
                source0, source1 = (predictions.image(family, scene, f"{key}/{i}", images) for i in (1, 2))
                pair = ImagePair(identity, family, scene, source0, source1, np.zeros((3, 3)))
                try:
                    K, R, t, matches = read(file, path, key, (source0, source1))
                    yield predictions.with_cameras(dataclasses.replace(pair, matches=matches), *K, R, t)
                except DataError as error:
                    yield dataclasses.replace(pair, problem=str(error))


def _posebench_pair(file: Any, path: Path, key: str, sources: Images) -> Stored:
    (K0, size0), (K1, size1) = (_camera(file, path, f"{key}/camera{i}", s) for i, s in enumerate(sources, start=1))
    R, t = h5.reshaped(file, f"{key}/R", 3, 3), h5.reshaped(file, f"{key}/t", 3)
    return (K0, K1), R, t, functools.partial(posebench_matches, path, key, (K0, K1), (size0, size1))


def _camera(file: Any, path: Path, key: str, source: ImageSource) -> tuple[Matrix, Size | None]:
    model = h5.text(file, f"{key}/model")
    parameters = h5.numbers(file, f"{key}/params").reshape(-1)
    count = FOCAL_LENGTHS.get(model)
    if count is None:
        raise DataError(f"{path}: {key + '/model'!r} is {model}; it must be one of {', '.join(FOCAL_LENGTHS)}")
    if len(parameters) < count + 2 or not np.isfinite(parameters).all():
        raise DataError(f"{path}: {key + '/params'!r} holds {parameters}, which are no parameters of {model}")
    if parameters[count + 2 :].any():
        raise DataError(f"{path}: {key + '/params'!r} of {model} has distortion; F needs undistorted points")
    K = Lens(parameters[0], parameters[count - 1], *parameters[count : count + 2]).K
    known = [f"{key}/{name}" for name in ("height", "width")]  # which some of PoseBench's cameras have not
    sides = [max(0, int(h5.reshaped(file, name, 1)[0])) if h5.holds(file, name) else 0 for name in known]
    if all(sides):
        return K, (sides[0], sides[1])
    return K, predictions.size_by_file(source, K)


def _oanet_pair(file: Any, path: Path, key: str, _: Images) -> Stored:
    known = oanet.cameras(file, key)
    return known.K, known.R, known.t, functools.partial(oanet.matches, path, key, known)


WITH_GEOMETRY: Mapping[str, Callable[[Path, Path | None], Iterator[ImagePair]]] = {
    "ransac_tutorial": tutorial_pairs,
    "posebench": functools.partial(_pairs, keys_of=h5.keys, read=_posebench_pair),
    "oanet": functools.partial(_pairs, keys_of=oanet.keys, read=_oanet_pair),
}
WITHOUT_GEOMETRY = {"hloc": 0.0, "glue_factory": 0.5, "vismatch": 0.0}  # of the first pixel's centre
LAYOUTS = (*WITHOUT_GEOMETRY, *WITH_GEOMETRY)


class H5Pairs(HeldPairs):
    """Pairs with given matches, which take the place of features and matcher.

    Args:
        root: the file, or the folder of the files, of the layout.
        layout: one of `LAYOUTS`.
        truth: for layouts without geometry, the folder of the `fmbench` set that they were computed on.
        images: folder of the images, for pictures and sizes, where the layout knows names of images.
        features, matches: names of hloc's two files in root; looked for when not given.
        origin: coordinates of the first pixel's centre; of the layout's convention when not given.

    What is wrong with one pair is its `problem`, or its failure when read. Raises DataError for files as a whole."""

    name = "h5"

    def __init__(
        self, root: str | Path | None = None, layout: str = "hloc", truth: str | Path | None = None,
        images: str | Path | None = None, features: str | None = None, matches: str | None = None,
        origin: float | None = None,
    ) -> None:  # fmt: skip
        if layout not in LAYOUTS:
            raise DataError(f"no layout {layout!r}; it must be one of {', '.join(LAYOUTS)}")
        folder = given_root(root, "h5", "the file, or the folder of the files, that hold the matches")
        if not folder.exists():
            raise DataError(f"{folder}: no such file or folder")
        folder = folder.resolve()
        digest = hashlib.blake2b(repr((layout, origin)).encode(), digest_size=16)
        if layout in WITH_GEOMETRY:
            _expect_unset(layout, truth=truth, features=features, matches=matches, origin=origin)
            self._pairs, files = _pairs_with_geometry(folder, layout, images)
        else:
            _expect_unset(layout, images=images, **({} if layout == "hloc" else {"features": features}))
            if truth is None:
                needed = (
                    "give dataset.truth=SET (a report: root=[FILES,SET]), the `fmbench` set that it was computed on"
                )
                raise DataError(f"layout {layout} holds no geometry: {needed}")
            known = FMBenchPairs(truth)
            digest.update(known.digest.encode())
            offset = WITHOUT_GEOMETRY[layout] if origin is None else origin
            if layout == "hloc":
                files = [_file_of_kind(folder, features, "features"), _file_of_kind(folder, matches, "matches")]
                self._pairs = list(predictions.hloc_pairs(known, files[0], files[1], offset))
            else:
                files = [_file_of_kind(folder, matches, "matches") if matches else _only(folder)]
                self._pairs = list(predictions.predicted_pairs(known, files[0], offset))
        for path in files:
            h5.add_to_digest(digest, path)
        if not self._pairs:
            raise DataError(f"{folder}: holds no pairs")
        self.digest = digest.hexdigest()


def _pairs_with_geometry(folder: Path, layout: str, images: str | Path | None) -> tuple[list[ImagePair], list[Path]]:
    """The pairs of a layout that has their geometry, and the files that hold them."""
    where = None if images is None else Path(images).expanduser()
    if where is not None and not where.is_dir():
        raise DataError(f"images={images}: no such folder; it must hold the images that the layout names")
    pairs = list(WITH_GEOMETRY[layout](folder, where))
    if where is not None:
        _expect_distinct(pairs, where)
    if layout != "ransac_tutorial":
        return pairs, h5.files(folder)
    return pairs, [path for scene in scenes(folder) for name in TUTORIAL if (path := scene / name).exists()]


def _expect_distinct(pairs: list[ImagePair], folder: Path) -> None:
    seen: dict[Path, str] = {}
    for pair in pairs:
        for path in (pair.image0.path, pair.image1.path):
            if path.exists() and seen.setdefault(path, pair.scene) != pair.scene:
                other = seen[path]
                folders = f"{folder / other} and {folder / pair.scene}"
                both = f"{path} would stand for images of the scenes {other} and {pair.scene}"
                raise DataError(f"{both}: give each a folder, {folders}")


def _expect_unset(layout: str, **options: Any) -> None:
    if unwanted := [name for name, value in options.items() if value is not None]:
        raise DataError(f"layout {layout} takes no {' or '.join(unwanted)}")


def _file_of_kind(folder: Path, name: str | None, kind: str) -> Path:
    if name is not None:
        path = folder / name
        if not path.is_file():
            raise DataError(f"{path}: no such file; dataset.{kind} must be a file in root")
        return path
    if not folder.is_dir():
        raise DataError(f"{folder}: must be the folder that holds hloc's two files")
    # hloc names matches after the features: feats-sift_matches-NN.h5
    files = [p for p in h5.files(folder) if ("match" in p.stem) == (kind == "matches")]
    files = [p for p in files if kind == "matches" or "feat" in p.stem or "keypoint" in p.stem] or files
    if len(files) != 1:
        names = ", ".join(p.name for p in files) or "none"
        raise DataError(f"{folder}: which file holds the {kind}? ({names}); give dataset.{kind}=NAME")
    return files[0]


def _only(root: Path) -> Path:
    files = h5.files(root)
    if len(files) != 1:
        raise DataError(f"{root}: holds {', '.join(p.name for p in files)}; give the file as root")
    return files[0]
