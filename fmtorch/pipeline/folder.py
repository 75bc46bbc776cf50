"""A folder of images: its pairs, the work on them by any workers, which can be resumed, and where results go.

Beside it what a pipeline made of pairs is kept for export: keypoints of images, matches, F and inliers of pairs."""

import contextlib
import dataclasses
import hashlib
import itertools
import json
import os
import re
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.failures import in_a_line, own_traceback
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import DataError, ImagePair, ImageSource, read_image
from fmtorch.geometry import cross_matrix, pose_from_fundamental
from fmtorch.io.match_store import MatchRecords, MatchStore, PairGeometry, StoredImage, StoredPair, indices
from fmtorch.jobs import Execution, Factory, Local, Source, TaskRunner, WorkerPool, available, in_order, one_thread
from fmtorch.jobs.runner import SHARED_BY
from fmtorch.pipeline.photographs import PhotographCamera, PhotographCameras, pair_geometries
from fmtorch.pipeline.pipeline import Outcome, Pipeline
from fmtorch.pipeline.two_images import Described, MatchResult, describe, relate
from fmtorch.two_view.pair_type import PairTypes

EXACT = (1.0, 0.0)  # px, relative deviation; K stands for the pixels


def match_records(pipeline: Pipeline, outcomes: Sequence[Outcome]) -> MatchRecords:
    """The outcomes' images and pairs for a `MatchStore`, by the paths of images; pairs of no use are left out."""
    records = MatchRecords({}, {})
    for outcome in outcomes:
        pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
        if not exportable(pair) or c is None or estimate is None:
            continue
        ends = pair.image0.path, pair.image1.path
        for image, K in ((pair.image0, pair.K0), (pair.image1, pair.K1)):
            if image.path not in records.images:
                records.images[image.path] = _stored_image(pipeline, image, K)
        F = estimate.F[0] if outcome.solved else torch.zeros(3, 3)
        points = records.images[ends[0]].points, records.images[ends[1]].points
        matched = c if outcome.keypoints is None else outcome.keypoints
        kept = _pair((str(ends[0]), str(ends[1])), points, matched, F, estimate.inliers[0], bool(estimate.related[0]))
        if outcome.pair_type is not None:
            kept = dataclasses.replace(kept, geometry=_geometry(kept.matches, c, estimate, outcome.pair_type))
        records.pairs[ends] = kept
    return records


def _geometry(matches: NDArray[np.int32], c: Correspondences, estimate: Estimate, pair_type: PairTypes) -> PairGeometry:
    """The geometry of one pair for COLMAP, whose surviving matches are these keypoints, (m, 2).
    Where the estimator was given nothing of cameras that are known, and F is determined, the pose is that of F."""
    if not c.asks_for_cameras and c.K0 is not None and c.K1 is not None and bool(pair_type.determined[0]):
        ends = estimate.F.double(), c.K0.double(), c.K1.double(), c.x0.double(), c.x1.double()
        pose = pose_from_fundamental(*ends, estimate.inliers & c.mask)
        estimate = estimate.derived(E=cross_matrix(pose.t) @ pose.R, R=pose.R, t=pose.t)
        c = c.derived(focal=torch.tensor([[EXACT, EXACT]], dtype=torch.float64, device=c.mask.device))
    index = np.zeros((c.mask.shape[1], 2), np.int32)
    index[c.mask[0].cpu().numpy()] = matches
    (geometry,) = pair_geometries([index], c, estimate, pair_type)
    return geometry


def exportable(pair: ImagePair) -> bool:
    """Whether a pair has images, as stored, that a pipeline finds keypoints in: not of a broken one, nor of given
    matches, nor where images are resized or turned when read."""
    resampled = pair.image0.resampling is not None or pair.image1.resampling is not None
    return pair.problem is None and pair.matches is None and not resampled


def exported_image(name: str, described: Described, camera: PhotographCamera | None = None) -> StoredImage:
    """A photograph's keypoints, with what is known of its camera, as a journal keeps them."""
    scores = described.features.scores.detach().cpu().float().numpy()
    lens = None if camera is None else camera.lens
    focal = None if camera is None or camera.focal is None else camera.focal[0]
    bends = lens is not None and lens.bends
    K = None if lens is None or bends else lens.K
    return StoredImage(name, _points(described), scores, described.size, K, lens if bends else None, focal)


def exported_match(names: tuple[str, str], described: tuple[Described, Described], result: MatchResult) -> StoredPair:
    """What was found of two photographs, as a journal keeps it."""
    points = _points(described[0]), _points(described[1])
    keypoints = result.putative.derived(mask=result.kept[None]).compact()
    pair = _pair(names, points, keypoints, result.F, result.inliers, result.related)
    if (geometry := result.geometry) is not None:
        geometry = geometry._replace(inliers=pair.matches[geometry.inliers[:, 0]])
    return dataclasses.replace(pair, geometry=geometry, significance=result.significance, pair_type=result.pair_type)


def _points(described: Described) -> NDArray[np.float32]:
    return described.points.detach().cpu().float().numpy()


def _stored_image(pipeline: Pipeline, image: ImageSource, K: NDArray[np.float64] | None) -> StoredImage:
    features, _ = pipeline.features(image)
    h, w = (int(n) for n in features.image_size)
    points, scores = (value.detach().cpu().float().numpy() for value in (features.keypoints, features.scores))
    return StoredImage(str(image.path), points, scores, (h, w), None if image.bending else K, image.bending)


def _pair(
    names: tuple[str, str], points: tuple[NDArray[np.float32], NDArray[np.float32]],
    c: Correspondences, F: Tensor, inliers: Tensor, related: bool,
) -> StoredPair:  # fmt: skip
    """The surviving matches of one pair, as the matcher left them, as indices of the images' points.
    Scores are the matcher's, or 1 - ratio, or 1. Raises ValueError for matches that are at no keypoint."""
    mask = c.mask[0].cpu()
    ends = (x[0].detach().cpu().float()[mask].numpy() for x in (c.x0, c.x1))
    index = [indices(keypoints, x) for keypoints, x in zip(points, ends, strict=True)]
    ambiguity = torch.zeros(len(mask)) if c.ambiguity is None else c.ambiguity[0].detach().cpu().float()
    scores = (1 - ambiguity[mask]).nan_to_num(0.0).clamp(0.0, 1.0)
    return StoredPair(
        *names, np.stack(index, -1).astype(np.int32), scores.numpy(), inliers.cpu()[mask].numpy(),
        F.detach().cpu().double().numpy(), related,
    )  # fmt: skip


SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
EXHAUSTIVE, SEQUENTIAL, SIMILAR = "exhaustive", "sequential", "similar"
CHOICES = f"{EXHAUSTIVE}, {SEQUENTIAL}:N, {SIMILAR}:N"
# Pictures that fmtorch draws beside a result.json; a set of pairs holds copies of photographs.
_DRAWN = ("matches.png", "pruning.png", "epipolar.png")
_SET_OF_PAIRS = "pairs.json"

Pair = tuple[Path, Path]


def images_below(folder: Path) -> list[Path]:
    """A folder's images at any depth, by name; none of fmtorch's or in hidden folders. Raises ValueError below two."""
    if not folder.is_dir():
        raise ValueError(f"images={folder} is no folder")
    images = sorted(_images(folder))
    if len(images) < 2:
        raise ValueError(f"images={folder} holds {len(images)} images ({', '.join(SUFFIXES)}); a pair needs two")
    return images


def _images(folder: Path) -> Iterator[Path]:
    for parent, folders, files in os.walk(folder):
        inside = Path(parent)
        seen = (name for name in folders if not name.startswith("."))
        folders[:] = [name for name in seen if not (inside / name / _SET_OF_PAIRS).is_file()]
        drawn = _DRAWN if "result.json" in files else ()
        for name in files:
            path = inside / name
            if path.suffix.lower() in SUFFIXES and name not in drawn and path.is_file():
                yield path


def count_of(pairs: Path | str | None, kind: str) -> int | None:
    """The N of ``pairs=kind:N``; None where something else is asked for. Raises ValueError where N is no number."""
    name, colon, number = str(pairs or "").partition(":")
    if name != kind:
        return None
    if not colon or not number.isdecimal() or int(number) < 1:
        raise ValueError(f"pairs={pairs}; it must be {kind}:N with a whole number N of at least 1, as {kind}:10")
    return int(number)


def chosen_pairs(folder: Path, images: Sequence[Path], pairs: Path | None) -> list[Pair]:
    """All pairs of the images, neighbours in the order of their names, or those of a file.
    pairs: ``exhaustive`` or None, ``sequential:N`` (each image with the N next ones), or a text file with the names of
    two images a line, below the folder. There an empty line and one that begins with # is left out, and a pair that
    stands there again. Raises ValueError for anything else, naming file and line for what is no pair."""
    if pairs is None or str(pairs) == EXHAUSTIVE:
        return list(itertools.combinations(images, 2))
    if count := count_of(pairs, SEQUENTIAL):
        ordered = sorted(images, key=lambda path: natural_order(path.relative_to(folder).as_posix()))
        return [(a, b) for i, a in enumerate(ordered) for b in ordered[i + 1 : i + 1 + count]]
    if not pairs.is_file():
        raise ValueError(f"pairs={pairs}: no such file; it must be {CHOICES}, or a file with two names per line")
    return _listed_pairs(folder, images, pairs)


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """A sort key by which numbers in names count as numbers: a2.jpg comes before a10.jpg."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part.casefold()) for part in parts if part]


def _listed_pairs(folder: Path, images: Sequence[Path], pairs: Path) -> list[Pair]:
    known = {path.relative_to(folder).as_posix(): path for path in images}
    selected: dict[frozenset[Path], Pair] = {}
    for number, line in enumerate(pairs.read_text(encoding="utf-8").splitlines(), start=1):
        names = line.split()
        if not names or names[0].startswith("#"):
            continue
        where = f"{pairs}, line {number}"
        if len(names) != 2 or names[0] == names[1]:
            raise ValueError(f"{where}: {line.strip()!r}; it must be the names of two images")
        missing = [name for name in names if name not in known]
        if missing:
            raise ValueError(f"{where}: no image {missing[0]} in {folder}")
        pair = known[names[0]], known[names[1]]
        selected.setdefault(frozenset(pair), pair)
    if not selected:
        raise ValueError(f"{pairs} names no pair")
    return list(selected.values())


def in_blocks(pairs: Sequence[Pair], block: int) -> list[Pair]:
    """The pairs in an order that needs few images at a time: `block` first ones meet one second image after another."""
    number = {image: i for i, image in enumerate(dict.fromkeys(itertools.chain.from_iterable(pairs)))}
    return sorted(pairs, key=lambda pair: (number[pair[0]] // block, number[pair[1]], number[pair[0]]))


RECORD = "export.json"


def default_output(folder: Path) -> Path:
    """``matches/NAME``, with some digits behind where that holds the matches of another folder of this name."""
    output = Path("matches") / folder.absolute().name
    with contextlib.suppress(OSError, ValueError):
        if json.loads((output / RECORD).read_text(encoding="utf-8"))["images"] != str(folder.absolute()):
            digest = hashlib.blake2b(str(folder.absolute()).encode(), digest_size=4).hexdigest()
            return output.with_name(f"{output.name}-{digest}")
    return output


ROWS = 1024  # of the matrix of similarities that exist at a time


def vectors_of(described: Iterable[Described | None], vector: Callable[[Tensor], Tensor]) -> Float[Tensor, "n d"]:
    """A vector for each image by its local descriptors; zeros where there is no image."""
    vectors = [None if each is None else vector(each.features.descriptors) for each in described]
    length = max((len(each) for each in vectors if each is not None), default=1)
    return torch.stack([torch.zeros(length) if each is None else each for each in vectors])


def similar_pairs(images: Sequence[Path], vectors: Float[Tensor, "n d"], count: int) -> list[Pair]:
    """Each image with its `count` most similar ones, by the inner products of the vectors; a pair once, in order.
    Images without a vector, zeros, are in no pair. Of equally similar ones those of lower number come first."""
    described = (vectors != 0).any(1)
    selected: set[tuple[int, int]] = set()
    for start in range(0, len(vectors), ROWS):
        similarity = vectors[start : start + ROWS] @ vectors.T
        similarity[:, ~described] = -torch.inf
        rows = torch.arange(len(similarity))
        similarity[rows, rows + start] = -torch.inf
        values, order = similarity.sort(dim=1, descending=True, stable=True)
        for row, (best, neighbors) in enumerate(zip(values[:, :count], order[:, :count], strict=True), start=start):
            if described[row]:
                selected |= {(min(row, j), max(row, j)) for j in neighbors[best > -torch.inf].tolist()}
    return [(images[i], images[j]) for i, j in sorted(selected)]


MEMORY = 64  # images whose features are kept for pairs to come
AHEAD = 4  # pairs a worker whose images are described before the first of them is matched
MAX_WORKERS = 8  # by default: each holds an image and its scale space
PRELOADED = (__name__,)  # by the process that workers are forked of


class ImageToDescribe(NamedTuple):
    """An image to describe, as `read_image` and `describe` take it; in place of `image`, why there is none."""

    path: Path
    image: ImageSource | str
    longest_side: int
    orient: bool


class DescribedPair(NamedTuple):
    """Two described images to match. names: of them, in the journal. known: `PhotographCameras.given`."""

    pair: Pair
    ends: tuple[Described, Described]
    names: tuple[str, str]
    seed: int
    known: Mapping[str, Any]


def described_or_matched(pipeline: Pipeline, task: ImageToDescribe | DescribedPair) -> Described | StoredPair | str:
    """What a worker does, by one thread: an image's features, what a journal keeps of a pair, or what went wrong."""
    try:
        with one_thread(pipeline.device):
            if isinstance(task, DescribedPair):
                return exported_match(task.names, task.ends, relate(pipeline, *task.ends, task.seed, **task.known))
            if isinstance(task.image, str):
                return task.image
            return describe(pipeline, read_image(task.image, orient=task.orient), task.longest_side)
    except Exception as error:  # one image, or one pair, does not end the work on the others
        return f"{in_a_line(error)}\n{own_traceback(error)}"


def folder_workers(pipeline: Pipeline, execution: Execution | None = None) -> WorkerPool:
    """The workers for `FolderMatches`; of threads one a core, or one for a GPU, unless `execution` says how many."""
    execution = execution or Execution()
    if execution.shared:
        usual = min(available(), MAX_WORKERS) if pipeline.device.type == "cpu" else 1
        return WorkerPool(dataclasses.replace(execution, workers=execution.workers or usual))
    torch.multiprocessing.set_sharing_strategy(SHARED_BY)  # type: ignore[no-untyped-call]
    return WorkerPool(execution, PRELOADED)


class FolderMatches:
    """Matches pairs of images into a journal, which this process alone writes; what that has already is taken.
    workers: who does it, not closed at the end. build: makes the pipeline in other
    processes; None: threads share it. cameras: of the images.
    done, taken, related: pairs matched now, taken from the journal, and of either those that show one scene."""

    def __init__(
        self, pipeline: Pipeline, journal: MatchStore, workers: WorkerPool, longest_side: int, orient: bool, seed: int,
        *, build: Callable[[], Pipeline] | None = None, cameras: PhotographCameras | None = None,
    ) -> None:  # fmt: skip
        self.pipeline, self.journal, self.cameras = pipeline, journal, cameras or PhotographCameras()
        self.longest_side, self.orient, self.seed = longest_side, orient, seed
        self.workers = workers
        self.source: Source[Pipeline] = Local(pipeline) if build is None else Factory(build)
        self.done = self.taken = self.related = self._failed = 0
        self._troubles: dict[tuple[Path, ...], str] = {}
        self.tracebacks: dict[str, None] = {}  # of the user's own parts, in order
        self._described: OrderedDict[Path, Described | None] = OrderedDict()  # None: it cannot be

    @property
    def troubles(self) -> list[str]:
        """What went wrong with images and pairs, in the order of their names; they are tried again the next time."""
        return [trouble for _, trouble in sorted(self._troubles.items())]

    def images(self, images: Sequence[Path]) -> Iterator[Described | None]:
        """The features of images, in their order; None of one that cannot be read."""
        photographs = map(self._photograph, images)
        for photograph, result in in_order(self.workers, self.source, described_or_matched, photographs):
            self._keep(photograph, result)
            yield self._described[photograph.path]
            self._forget(set())

    def each(self, pairs: Sequence[Pair]) -> Iterator[None]:
        """Match the pairs, keep what is found of each, and yield after it.
        Raises WorkersLost where workers die whatever they do, or a scheduler is gone."""
        before = self._passed
        runner = TaskRunner(self.workers, self.source, described_or_matched, self._keep, self._keep)
        for _ in runner.each(self._tasks(pairs)):
            while before < self._passed:
                before += 1
                yield
        yield from [None] * (self._passed - before)

    @property
    def _passed(self) -> int:
        return self.done + self.taken + self._failed

    def _tasks(self, pairs: Sequence[Pair]) -> Iterator[ImageToDescribe | DescribedPair | None]:
        """Pairs as soon as their images are described, and before them these; None where others must end first."""
        todo = iter(in_blocks(pairs, MEMORY // 2))
        ahead = max(MEMORY // 2, AHEAD * self.workers.size)
        begun, describing = list[Pair](), set[Path]()
        while True:
            ready = next((pair for pair in begun if all(image in self._described for image in pair)), None)
            if ready is not None:
                begun.remove(ready)
                if (task := self._described_pair(ready)) is not None:
                    yield task
            elif len(begun) < ahead and (pair := next(todo, None)) is not None:
                if self.journal.has_pair(*pair):
                    self.taken += 1
                    self.related += self.journal.pair(*pair).related
                    continue
                begun.append(pair)
                describing -= self._described.keys()
                for image in pair:
                    if image in self._described:
                        self._described.move_to_end(image)
                    elif image not in describing:
                        describing.add(image)
                        yield self._photograph(image)
                self._forget({image for pair in begun for image in pair})
            elif begun:
                yield None
            else:
                return

    def _photograph(self, image: Path) -> ImageToDescribe:
        try:
            source: ImageSource | str = self.cameras.source(image)
            if self.workers.execution.send_images:
                source = dataclasses.replace(source, data=image.read_bytes())  # type: ignore[type-var]
        except (DataError, OSError) as error:  # no camera, or no file
            source = in_a_line(error)
        return ImageToDescribe(image, source, self.longest_side, self.orient)

    def _described_pair(self, pair: Pair) -> DescribedPair | None:
        end0, end1 = (self._described[image] for image in pair)
        if end0 is None or end1 is None:
            self._failed += 1
            return None
        names = self.journal.name(pair[0]), self.journal.name(pair[1])
        try:
            known = self.cameras.given(pair, [end0.size, end1.size])
        except Exception as error:
            self._fail(pair, in_a_line(error))
            return None
        return DescribedPair(pair, (end0, end1), names, self.seed, known)

    def _keep(self, task: ImageToDescribe | DescribedPair, result: Any) -> None:
        trouble, _, trace = (result if isinstance(result, str) else self._not_stored(task, result)).partition("\n")
        self.tracebacks |= {trace: None} if trace else {}
        if isinstance(task, ImageToDescribe):
            self._described[task.path] = None if trouble else result
            self._troubles |= {(task.path,): trouble} if trouble else {}
        elif trouble:
            self._fail(task.pair, trouble)
        else:
            self.done += 1
            self.related += result.related

    def _not_stored(self, task: ImageToDescribe | DescribedPair, result: Any) -> str:
        """Add an image or a pair to the journal; why it cannot be, else empty."""
        try:
            if isinstance(task, DescribedPair):
                self.journal.add_pair(*task.pair, result)
            elif not self.journal.has_image(task.path):
                camera = self.cameras.of(task.path, result.size)
                self.journal.add_image(task.path, exported_image(self.journal.name(task.path), result, camera))
        except Exception as error:
            return in_a_line(error)
        return ""

    def _fail(self, pair: Pair, reason: str) -> None:
        self._failed += 1
        self._troubles[pair] = f"{self.journal.name(pair[0])}, {self.journal.name(pair[1])}: {reason}"

    def _forget(self, needed: set[Path]) -> None:
        for image in [*self._described]:
            if len(self._described) <= MEMORY:
                return
            if image not in needed:
                del self._described[image]
