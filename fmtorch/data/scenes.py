"""Which pairs of a scene's images to look at: in videos those a second apart, else all, or those sharing 3-D points."""

import dataclasses
import functools
import hashlib
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fmtorch.data.files import Array, DataError, Indices, Matrix, Singles
from fmtorch.data.images import ImageError
from fmtorch.data.pairs import Camera, ImagePair, ImageSource, PairDataset, fundamental, relative_pose, share_centre

WINDOW = 1.0  # s: a frame is paired with those of the following second (Bian et al., BMVC 2019, Section 3)
MIN_SHARED = 1  # points of a reconstruction that two images must both see
_ROUNDING = 1e-6  # s, of time stamps in text files
_AT_ONCE = 512  # images whose shared points are counted together


class AllPairs:
    """All pairs of n images, in the order (0, 1), (0, 2), ..., (1, 2), ..."""

    def __init__(self, n: int) -> None:
        self.n = n
        self._starts = np.cumsum([0, *range(n - 1, 0, -1)])  # where the pairs that begin with image i begin

    def __len__(self) -> int:
        return self.n * (self.n - 1) // 2

    def at(self, ranks: Indices) -> Indices:
        """The pairs (n, 2) at these places (n,)."""
        first = np.searchsorted(self._starts, ranks, side="right") - 1
        return np.stack([first, first + 1 + ranks - self._starts[first]], -1)


class ListedPairs:
    """Pairs (n, 2) that are listed."""

    def __init__(self, pairs: Indices) -> None:
        self.pairs = pairs.reshape(-1, 2)

    def __len__(self) -> int:
        return len(self.pairs)

    def at(self, ranks: Indices) -> Indices:
        return self.pairs[ranks]


Candidates = AllPairs | ListedPairs  # pairs (i, j), i < j, in a fixed order; not necessarily all in memory


def following(times: Sequence[float] | Matrix, window: int | float = WINDOW) -> ListedPairs:
    """Each frame with those at most `window` seconds later; times (n,) in seconds, ascending."""
    t = np.asarray(times, dtype=np.float64)
    ends = np.searchsorted(t, t + window + _ROUNDING, side="right")
    counts = ends - np.arange(len(t)) - 1
    first = np.repeat(np.arange(len(t)), counts)
    within = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    return ListedPairs(np.stack([first, first + 1 + within], -1).astype(np.int64))


def sharing_points(points: Sequence[Indices], minimum: int = MIN_SHARED) -> ListedPairs:
    """The pairs of images that both see at least `minimum` points; points: of each image the numbers it sees.
    Memory is that of the pairs found: about m / 2 for each point of a mean track of m images, mostly the same ones."""
    sees = incidence(points)
    blocks = []
    for begin in range(0, len(points), _AT_ONCE):
        shared = (sees[begin : begin + _AT_ONCE] @ sees.T).tocoo()
        first, second = shared.row.astype(np.int64) + begin, shared.col.astype(np.int64)
        kept = (shared.data >= minimum) & (first < second)
        pairs = np.stack([first[kept], second[kept]], -1)
        blocks.append(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])
    return ListedPairs(np.concatenate([*blocks, np.zeros((0, 2), np.int64)]))


def collection_pairs(views: int, points: Sequence[Indices] | None, minimum: int) -> Candidates:
    """All pairs of views, or those that see as many points in common; points: that each view sees, None: all pairs."""
    return AllPairs(views) if points is None else sharing_points(points, minimum)


def incidence(points: Sequence[Indices]) -> Any:
    """A sparse array of SciPy's (images, points), 1 where an image sees a point; points: the numbers of those."""
    import scipy.sparse  # which takes longer to import than a small database to verify

    seen = [np.unique(p) for p in points]
    _, columns = np.unique(np.concatenate([*seen, np.zeros(0, np.int64)]), return_inverse=True)
    return scipy.sparse.csr_array(
        (np.ones(len(columns), np.int32), columns.astype(np.int64), np.cumsum([0, *map(len, seen)])),
        shape=(len(seen), int(columns.max(initial=-1)) + 1),
    )


def drawn(total: int, count: int | None, seed: int) -> Sequence[int] | Indices:
    """Places of `count` of `total` pairs, drawn at random by the seed and sorted; all where there are no more."""
    if count is None or count >= total:
        return range(total)
    return np.sort(np.random.default_rng(seed).choice(total, count, replace=False))


# Which sequences the paper trains and tests on (Bian et al., BMVC 2019, Section 4 and its supplement)

SPLITS: dict[str, dict[str, tuple[str, ...]]] = {  # names of sequences or scenes; without `train`: all others
    "tum": {"test": tuple(f"rgbd_dataset_freiburg3_{n}" for n in ("teddy", "large_cabinet", "long_office_household"))},
    "kitti": {"test": ("06", "07", "08", "09", "10"), "train": ("00", "01", "02", "03", "04", "05")},
    "colmap": {
        "test": ("Panther", "Playground", "Train", "Roman_Forum"),
        "train": ("Family", "Francis", "Horse", "Lighthouse", "M60"),
    },
}  # fmt: skip


def chosen(name: str, split: str, sequences: Sequence[str] | None, there: Sequence[str]) -> list[str]:
    """The sequences to read: those asked for, or those of the split.
    there: those on disk, for a split of "all others". Raises DataError for an unknown split, and where none is left."""
    if split not in ("test", "train"):
        raise DataError(f"split {split!r}; there are test and train")
    if sequences is not None:
        names = list(sequences)
    elif split in SPLITS[name]:
        names = list(SPLITS[name][split])
    else:
        names = sorted(set(there) - set(SPLITS[name]["test"]))
    if not names:
        raise DataError(f"{name}: no sequence in split {split!r}; dataset.sequences=[...] names some")
    if len(set(names)) < len(names):
        raise DataError(f"sequences={names}: one is named twice")
    return names


# Depth of each pixel of a photograph, measured or reconstructed, kept in a file beside it

_KEPT = 8  # depth images that are remembered, some MB each
_COLMAP_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&1&")


class DepthImages:
    """Depth images by the identity of the photographs, pixel by pixel on the photographs as they were taken.
    paths: of the depth images, scene by scene. scale: their values per unit of length; 0 and less is no measurement.
    read: the values (h, w) of a file. reduced: whether they may be smaller than their photographs, in proportion."""

    def __init__(
        self, paths: Iterable[Mapping[str, Path]], scale: float, read: Callable[[Path], Array], reduced: bool = False
    ) -> None:
        self.paths = {identity: path for of_scene in paths for identity, path in of_scene.items()}
        self.scale, self.read, self.reduced = scale, read, reduced

    def at(self, image: ImageSource, points: Matrix) -> Matrix:
        """Depth (n,) along the optical axis at points (n, 2) of the undistorted image: that of the nearest pixel.
        NaN outside, where nothing was measured, and everywhere in a photograph without a depth image. Raises ImageError
        for a file that cannot be read or does not have the photograph's size."""
        if image.identity not in self.paths:
            return np.full(len(points), np.nan)
        path = self.paths[image.identity]
        pixels = self.read(path)
        h, w = pixels.shape
        height, width = image.size or (h, w)
        in_proportion = h <= height and abs(h * width / height - w) <= 1
        if (h, w) != (height, width) and not (self.reduced and in_proportion):
            raise ImageError(f"{path}: {(h, w)} px; its photograph has {image.size}")
        there = points if image.lens is None else image.lens.distort(points)
        if (h, w) != (height, width):
            there = (there + 0.5) * [w / width, h / height] - 0.5
        column, row = np.round(np.nan_to_num(there, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
        value = np.where(inside, pixels[np.where(inside, row, 0), np.where(inside, column, 0)], 0).astype(np.float64)
        return np.where(value > 0, value / self.scale, np.nan)


@functools.lru_cache(maxsize=_KEPT)
def read_grey(path: Path) -> Array:
    """A grey image with 16 bits (h, w). Raises ImageError for anything else."""
    _expect_file(path)
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ImageError(f"{path}: it must be a depth image, grey with 16 bits")
    return pixels


@functools.lru_cache(maxsize=_KEPT)
def read_colmap(path: Path) -> Singles:
    """COLMAP's depth map (h, w): ``width&height&1&``, then float32, row by row. Raises ImageError for anything else."""
    _expect_file(path)
    content = path.read_bytes()
    header = _COLMAP_HEADER.match(content)
    if header is None:
        raise ImageError(f"{path}: it must be a depth map of COLMAP, which begins with width&height&1&")
    w, h = (int(number) for number in header.groups())
    there = len(content) - header.end()
    if there != 4 * w * h or not there:
        raise ImageError(f"{path}: {there} bytes of depth; {w} x {h} px have {4 * w * h}: is it truncated?")
    return np.frombuffer(content, np.dtype("<f4"), offset=header.end()).reshape(h, w)


def _expect_file(path: Path) -> None:
    if not path.is_file():
        raise ImageError(f"{path}: no such file; it must be a depth image")


@dataclasses.dataclass(frozen=True, eq=False)
class View(Camera):
    """One image with its camera: K (3, 3), R (3, 3) and t (3,) map the world to pixels of the undistorted image.
    place: the file and line, or the record, that names the image; messages begin with it."""

    image: ImageSource
    place: str

    @property
    def problem(self) -> str:
        """Why it cannot be used; empty where the image is there."""
        return "" if self.image.path.is_file() else f"{self.place}: no image {self.image.path}"


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """The views of one sequence or collection, in a fixed order, and which pairs of them may be looked at."""

    name: str
    family: str
    views: Sequence[View]
    candidates: Candidates


class ScenePairs(PairDataset):
    """Pairs of the views of scenes: some of all candidates, drawn by a seed.

    name: of the data set. scenes: read from disk. sources: what defines the cameras, by a name that holds no path.
    options: what else defines them, such as the window of a video.
    pairs: how many, drawn at random from the candidates of all scenes; None: all. seed: of that draw.
    depth: of points (n, 2) of an image, in the unit of t, where the views have depth: it is a `DepthDataset` then.

    points: of each scene what reads which points each view sees, by numbers; None without a reconstruction.

    A pair with a missing image or both cameras at one place has a `problem`. Whether it matches is not asked."""

    points: Sequence[Callable[[], Sequence[Indices]]] | None = None

    def __init__(
        self, name: str, scenes: Sequence[Scene], sources: Iterable[tuple[str, Path]], options: Sequence[object] = (),
        pairs: int | None = None, seed: int = 0, depth: Callable[[ImageSource, Matrix], Matrix] | None = None,
    ) -> None:  # fmt: skip
        self.name, self.scenes = name, list(scenes)
        if depth is not None:
            self.depth = depth
        self._starts = [0, *itertools.accumulate(len(scene.candidates) for scene in self.scenes)]
        self._ranks = drawn(self._starts[-1], pairs, seed)
        self.cameras_digest = _digest([(s.family, s.name, len(s.candidates)) for s in self.scenes], options, sources)
        self.digest = hashlib.blake2b(f"{self.cameras_digest} {pairs} {seed}".encode(), digest_size=16).hexdigest()

    def __len__(self) -> int:
        return len(self._ranks)

    def __getitem__(self, index: int) -> ImagePair:
        scene, i, j = self.candidate(int(self._ranks[index]))
        return image_pair(self.scenes[scene], i, j)

    @property
    def candidates(self) -> int:
        return self._starts[-1]

    def candidate(self, rank: int) -> tuple[int, int, int]:
        """The candidate at a place among those of all scenes: number of the scene, and of its two views."""
        scene = int(np.searchsorted(self._starts, rank, side="right")) - 1
        ((i, j),) = self.scenes[scene].candidates.at(np.array([rank - self._starts[scene]]))
        return scene, int(i), int(j)


def image_pair(scene: Scene, i: int, j: int) -> ImagePair:
    """Views i and j of a scene as a pair; F is zero, with a `problem`, where the two cameras are at one place."""
    a, b = scene.views[i], scene.views[j]
    problems = [problem for problem in (a.problem, b.problem) if problem]
    apart = not share_centre(a, b)
    if not apart:
        problems.append(f"{a.place} and {b.place}: both cameras are at one place, hence there is no F")
    F, motion = fundamental(a, b) if apart else np.zeros((3, 3)), relative_pose(a, b)
    identity, problem = f"{scene.family}/{scene.name}/{i}-{j}", "; ".join(problems) or None
    return ImagePair(identity, scene.family, scene.name, a.image, b.image, F, a.K, b.K, *motion, problem)


def folders(root: Path, wanted: Sequence[str], what: str) -> list[Path]:
    """The folders of these names below `root`. Raises DataError naming the first that is missing, and those there."""
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; it must hold {what}")
    for name in wanted:
        if not (root / name).is_dir():
            there = ", ".join(sorted(f.name for f in root.iterdir() if f.is_dir())) or "none"
            raise DataError(f"{root}: no sequence {name!r}; there are: {there}. dataset.sequences=[...] takes others")
    return [root / name for name in wanted]


def _digest(scenes: object, options: Sequence[object], sources: Iterable[tuple[str, Path]]) -> str:
    digest = hashlib.blake2b(repr((scenes, list(options))).encode(), digest_size=16)
    for name, path in sources:
        with path.open("rb") as file:
            digest.update(f"{name}:{path.stat().st_size}:".encode() + hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()
