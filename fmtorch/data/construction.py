"""Which pairs of images with known cameras make a data set: the paper's rule, or how much of the scene both show."""

import dataclasses
import functools
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from fmtorch.core import claim
from fmtorch.core.files import replacing, write_whole
from fmtorch.data.files import Indices, Matrix, Pixels, Singles
from fmtorch.data.fmbench import CAMERAS, IMAGES, SUFFIXES
from fmtorch.data.images import ImageError, read_image, to_grey
from fmtorch.data.pairs import DepthDataset, ImageSource, line_distance
from fmtorch.data.scenes import ScenePairs, View, image_pair, incidence

STEP = 4  # px between the pixels of which depth is asked, along rows and columns
TOLERANCE = 0.05  # by which depths may differ, relative to the one seen, for the same surface

Place = tuple[int, int, int]  # number of the scene, and of its two views


def overlap_of(dataset: ScenePairs) -> "DepthOverlap | PointOverlap":
    """Overlaps by depth where the data set knows it, else by points. Raises ValueError where it has neither."""
    if isinstance(dataset, DepthDataset):
        return DepthOverlap(dataset)
    if dataset.points is not None:
        return PointOverlap(dataset.points)
    needed = f"overlap needs depth or the points of a reconstruction and dataset={dataset.name} has neither"
    raise ValueError(f"{needed}; it must be rendered, colmap, bundler, or tum with depth images")


class PointOverlap:
    """By the points of reconstructions; points: of each scene a function that reads which points each view sees."""

    def __init__(self, points: Sequence[Callable[[], Sequence[Indices]]]) -> None:
        self.points = points
        self._last: tuple[int, Any] | None = None  # a scene, and which of its views sees what

    @property
    def record(self) -> dict[str, Any]:
        return {"by": "points"}

    def of(self, place: Place) -> float:
        """The overlap of a pair, from 0 to 1: points that both views see, over those of the view that sees more."""
        scene, i, j = place
        last = self._last
        if last is None or last[0] != scene:
            last = self._last = scene, incidence(self.points[scene]())
        return float(shared_points(last[1], np.array([[i, j]]))[0])


def shared_points(sees: Any, pairs: Indices) -> Matrix:
    """Overlaps (n,) of pairs (n, 2) of images: points that both see, over those of the image that sees more of them.
    sees: which image sees which point, as `incidence` gives it. Zero where an image sees none."""
    counts = np.diff(sees.indptr)[pairs]
    shared = sees[pairs[:, 0]].multiply(sees[pairs[:, 1]]).sum(1)
    larger = counts.max(1, initial=0)
    return np.asarray(np.divide(shared, larger, out=np.zeros(len(pairs)), where=larger > 0))


class Seen(NamedTuple):
    """An image as a share of its pixels needs it: K (3, 3), size (h, w), and depth (n,) at points (n, 2)."""

    K: Matrix
    size: tuple[int, int]
    depth: Callable[[Matrix], Matrix]


class DepthOverlap:
    """By the depth of pixels; dataset: a `ScenePairs` with depth."""

    def __init__(self, dataset: ScenePairs) -> None:
        assert isinstance(dataset, DepthDataset)
        self.dataset, self._depth = dataset, dataset.depth

    @property
    def record(self) -> dict[str, Any]:
        return {"by": "depth", "step_px": STEP, "tolerance": TOLERANCE}

    def of(self, place: Place) -> float:
        """The overlap of a pair, from 0 to 1. Raises ImageError where a depth image cannot be read."""
        scene, i, j = place
        views = self.dataset.scenes[scene].views
        pair = image_pair(self.dataset.scenes[scene], i, j)
        assert pair.R is not None
        assert pair.t is not None
        a, b = self._seen(views[i]), self._seen(views[j])
        return min(seen_share(a, b, pair.R, pair.t), seen_share(b, a, pair.R.T, -pair.R.T @ pair.t))

    def _seen(self, view: View) -> Seen:
        size = view.image.size
        if size is None:
            height, width = read_image(view.image).shape[:2]
            size = height, width
        return Seen(view.K, size, functools.partial(self._depth, view.image))


def seen_share(image: Seen, other: Seen, R: Matrix, t: Matrix) -> float:
    """The share of an image's pixels with depth that another image sees; 0 where no pixel counts.
    A pixel is seen where its point X, which is ``R X + t`` to the other camera, lies within the other image and has the
    depth that is known there, to `TOLERANCE`. Pixels for which no depth is known there are left out. Both depths are in
    the unit of t (3,); one pixel in `STEP` is looked at, along rows and columns."""
    h, w = image.size
    rows, columns = np.mgrid[STEP // 2 : h : STEP, STEP // 2 : w : STEP].reshape(2, -1).astype(np.float64)
    depth = image.depth(np.stack([columns, rows], 1))
    has = np.isfinite(depth)
    rays = np.stack([columns, rows, np.ones_like(rows)], 1)[has] @ np.linalg.inv(image.K).T
    X = (rays * depth[has, None]) @ R.T + t
    ahead = X[X[:, 2] > 0]
    x = ahead @ other.K.T
    x = x[:, :2] / x[:, 2:]
    within = ((x >= -0.5) & (x < np.array(other.size[::-1]) - 0.5)).all(1)
    known = other.depth(x[within])
    unknown = np.isnan(known)
    same = np.abs(known - ahead[within, 2]) <= TOLERANCE * known
    count = len(X) - unknown.sum()
    return float(same.sum() / count) if count else 0.0


SIFT_FEATURES, RATIO, NEAR_LINE, ENOUGH = 8000, 0.8, 1.0, 20
_AT_ONCE = 512  # keypoints that are matched together

Keypoints = tuple[Matrix, Singles]


def keypoints(grey: Pixels) -> Keypoints:
    """OpenCV's SIFT: points (n, 2) and descriptors (n, 128)."""
    detected, descriptors = cv2.SIFT.create(nfeatures=SIFT_FEATURES).detectAndCompute(grey, np.ones_like(grey))
    if not detected:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    return np.array([k.pt for k in detected], dtype=np.float64), descriptors.astype(np.float32)


def ratio_matches(a: Keypoints, b: Keypoints) -> tuple[Matrix, Matrix]:
    """Nearest neighbours from the first image to the second that pass the ratio test: points (n, 2) and (n, 2)."""
    if len(a[0]) == 0 or len(b[0]) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    distance = (a[1] ** 2).sum(1)[:, None] + (b[1] ** 2).sum(1) - 2 * a[1] @ b[1].T
    rows = np.arange(len(distance))
    best = distance.argmin(1)
    first = distance[rows, best].copy()
    distance[rows, best] = np.inf
    good = np.maximum(first, 0) < RATIO**2 * distance.min(1)
    return a[0][good], b[0][best[good]]


def matchable(a: Keypoints, b: Keypoints, F: Matrix) -> bool:
    """Whether more than `ENOUGH` ratio matches lie within `NEAR_LINE` pixels of the true lines in both images.
    Looks at some of the first image's keypoints at a time, until there are enough."""
    near = 0
    for begin in range(0, len(a[0]), _AT_ONCE):
        block = a[0][begin : begin + _AT_ONCE], a[1][begin : begin + _AT_ONCE]
        near += int((line_distance(F, *ratio_matches(block, b)) < NEAR_LINE).sum())
        if near > ENOUGH:
            return True
    return False


# Which candidates of a data set make pairs, by the paper's rule or by overlap, and FM-Bench's layout of these pairs

BLOCK = 64  # candidates that one worker judges at a time
MAX_DRAWN = 10_000_000  # candidates of which an order is drawn, 80 MB; with more, among so many drawn at random
RULE = {"features": SIFT_FEATURES, "ratio": RATIO, "near_line_px": NEAR_LINE, "more_than": ENOUGH}
_VERSION = 1  # of the rule and the layout


@dataclasses.dataclass(frozen=True)
class Verdicts:
    """What became of a block's candidates: whether each makes a pair, and what was wrong with images, each once."""

    kept: list[bool]
    problems: list[str]


@dataclasses.dataclass(frozen=True, eq=False)
class Construction:
    """The construction of pairs in a folder.
    dataset: with the candidates. folder: of the set that is made; its name is the set's. count: how many pairs, drawn
    at random by `seed`; None: all. quality: of JPEG images that are written because they were undistorted.
    overlap: the least and the greatest overlap of pairs; None: the paper's rule.
    matches: what the matches are computed by that take the place of images; None: images. Raises ValueError, when its
    `rule` is first asked for, where the data set's overlaps are not known."""

    dataset: ScenePairs
    folder: Path
    count: int | None = None
    seed: int = 0
    quality: int = 95
    overlap: tuple[float, float] | None = None
    matches: Mapping[str, Any] | None = None

    @functools.cached_property
    def overlaps(self) -> DepthOverlap | PointOverlap:
        return overlap_of(self.dataset)

    @property
    def rule(self) -> dict[str, Any]:
        return RULE if self.overlap is None else {"overlap": list(self.overlap), **self.overlaps.record}

    @property
    def identity(self) -> dict[str, Any]:
        return {
            "version": _VERSION, "opencv": ".".join(cv2.__version__.split(".")[:2]), "dataset": self.dataset.name,
            "cameras": self.dataset.cameras_digest, "rule": self.rule, "count": self.count, "seed": self.seed,
            "quality": self.quality, **({} if self.matches is None else {"matches": dict(self.matches)}),
        }  # fmt: skip

    @property
    def work(self) -> Path:
        """The folder of features and verdicts, which goes when the set is complete."""
        return self.folder / "work"

    @property
    def complete(self) -> bool:
        return (self.folder / ("pairs_with_gt.txt" if self.matches is None else "summary.json")).is_file()

    def begin(self) -> None:
        """Make the folder, or go on with it. Raises ValueError where it holds another set, or anything else."""
        claim(self.folder / "pairs.json", self.identity, "pairs", "name another folder as output")
        self.work.mkdir(exist_ok=True)

    def order(self) -> Sequence[int] | Indices:
        total, rng = self.dataset.candidates, np.random.default_rng(self.seed)
        if self.count is None:
            return range(total)
        return rng.permutation(total) if total <= MAX_DRAWN else rng.choice(total, MAX_DRAWN, replace=False)

    def judge(self, numbered: tuple[int, Sequence[int]]) -> Verdicts:
        """Judge the candidates of a block, after its number, and keep the verdicts; what was judged before is read."""
        block, ranks = numbered
        file = self.work / "verdicts" / f"{block:08d}.json"
        if file.is_file():
            return Verdicts(**json.loads(file.read_text(encoding="utf-8")))
        kept, problems = [False] * len(ranks), list[str]()
        places = [self.dataset.candidate(rank) for rank in ranks]
        for k in sorted(range(len(places)), key=places.__getitem__):  # scene by scene: what is known of one is kept
            try:
                kept[k] = self._passes(places[k])
            except ImageError as error:
                problems.append(str(error))
        verdicts = Verdicts(kept, sorted(set(problems)))
        file.parent.mkdir(exist_ok=True)
        write_whole(file, json.dumps(dataclasses.asdict(verdicts)))
        return verdicts

    def _passes(self, place: tuple[int, int, int]) -> bool:
        """Whether a candidate passes the rule. Raises ImageError where that cannot be said."""
        scene, i, j = place
        pair = image_pair(self.dataset.scenes[scene], i, j)
        if pair.problem is not None:
            raise ImageError(pair.problem)
        if self.overlap is None:
            return matchable(self._keypoints(pair.image0), self._keypoints(pair.image1), pair.F)
        low, high = self.overlap
        if not low <= self.overlaps.of(place) <= high:
            return False
        for image in (pair.image0, pair.image1):
            read_image(image)
        return True

    def write_image(self, image: tuple[int, int]) -> None:
        """Write one image (scene, number) unless it is there: the file itself, or as JPEG what was undistorted."""
        scene, number = image
        drawn = self.dataset.scenes[scene]
        source = drawn.views[number].image
        suffix = source.path.suffix if _as_it_is(source) else SUFFIXES[0]
        target = self.folder / drawn.name / IMAGES / f"{number:08d}{suffix}"
        if target.is_file():
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacing(target) as path:
            if _as_it_is(source):
                shutil.copyfile(source.path, path)
                return
            pixels = read_image(source)
            colour = pixels if pixels.ndim == 2 else pixels[..., ::-1]
            path.write_bytes(cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1].tobytes())

    def finish(self, ranks: Sequence[int], summary: Mapping[str, Any]) -> None:
        """Write the set's text files, the list of pairs last, once its images or matches are there, and drop `work`."""
        files = {"summary.json": json.dumps(dict(summary), indent=1) + "\n"}
        if self.matches is None:
            places = sorted(self.dataset.candidate(rank) for rank in ranks)
            for number in sorted({scene for scene, _, _ in places}):
                self._write_scene(number)
            pairs = [(self.dataset.scenes[scene], i, j) for scene, i, j in places]
            files["pairs_which_dataset.txt"] = "".join(f"{scene.name}/\n" for scene, _, _ in pairs)
            files["pairs_with_gt.txt"] = "".join(f"{i} {j} {_numbers(image_pair(s, i, j).F)}\n" for s, i, j in pairs)
        for name, text in files.items():
            write_whole(self.folder / name, text)
        shutil.rmtree(self.work, ignore_errors=True)

    def used(self, ranks: Sequence[int]) -> list[tuple[int, int]]:
        """The images (scene, number) of pairs, each once."""
        places = [self.dataset.candidate(rank) for rank in ranks]
        return sorted({(scene, number) for scene, i, j in places for number in (i, j)})

    def _write_scene(self, number: int) -> None:
        """The cameras and the names at the source of all images of a scene."""
        scene = self.dataset.scenes[number]
        lines = [f"{_numbers(view.K)} {_numbers(view.R)} {_numbers(view.t)}\n" for view in scene.views]
        names = [f"{i:08d} {view.image.identity}\n" for i, view in enumerate(scene.views)]
        for name, text in ((CAMERAS, lines), ("names.txt", names)):
            write_whole(self.folder / scene.name / name, "".join(text))

    def _keypoints(self, image: ImageSource) -> Keypoints:
        """SIFT of an image, from the work folder where it is there; descriptors are whole numbers up to 255."""
        path = self.work / "features" / f"{image.identity}.npz"
        if path.is_file():
            with np.load(path) as file:
                return file["points"].astype(np.float64), file["descriptors"].astype(np.float32)
        points, descriptors = keypoints(to_grey(read_image(image)))
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, points=points.astype(np.float32), descriptors=descriptors.astype(np.uint8))
        return points, descriptors


def _as_it_is(source: ImageSource) -> bool:
    return source.lens is None and source.path.suffix in SUFFIXES


def _numbers(values: Matrix) -> str:
    return " ".join(repr(float(value)) for value in values.ravel())


def blocks(order: Sequence[int] | Indices) -> Iterator[tuple[int, list[int]]]:
    """The blocks of an order of candidates: their numbers and candidates."""
    for begin in range(0, len(order), BLOCK):
        yield begin // BLOCK, [int(rank) for rank in order[begin : begin + BLOCK]]
