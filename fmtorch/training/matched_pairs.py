"""Labelled matches: `MatchedPairs` of image pairs through a pipeline's first stages, `OANetPairs` of OANet's files."""

import functools
import hashlib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig

from fmtorch import presets
from fmtorch.core import Correspondences, files
from fmtorch.core.types import pair_key
from fmtorch.data.files import DataError, Matrix
from fmtorch.data.pairs import Camera, DepthDataset, ImagePair, PairDataset, fundamental, line_distance
from fmtorch.io import h5, oanet, predictions
from fmtorch.jobs import Execution, Factory, Local, Source, TaskRunner, WorkerPool, use_one_thread
from fmtorch.pipeline.pipeline import Outcome, Pipeline, load_pipeline
from fmtorch.runs import CachedFeatures, cached, identity_digest
from fmtorch.runs.fingerprint import configuration, environment
from fmtorch.training import labelled
from fmtorch.training.stored_matches import ARRAYS, FORMAT, Shard, ShardError, StoredMatches, write_shard

MAX_MATCHES = 4000  # kept of a pair, the least ambiguous
Progress = Callable[[int, int], None]  # called with (pairs done, pairs in all)
SHARD = 32  # pairs in a file, all of one scene: what an interruption can cost; a change is one of FORMAT
PRELOADED = (__name__,)  # by the process that workers are forked of
_IMAGES = 64  # whose features each worker may need again


class MatchedPairs(StoredMatches):
    """Labelled matches of the pairs of any data set with ground truth; for torch's DataLoader with `collate`.

    Matches are computed once, by `workers` threads, and kept on disk; an interrupted computation goes on where it
    stopped, a damaged file is computed anew. The folder's name holds a digest of all that defines them: data set,
    stages before estimation, label rules, libraries. Pairs come ordered by family, scene and images. A pipeline without
    a ratio test leaves the threshold to the `augmentation`. Several processes may compute one folder at once.

    Args:
        dataset: image pairs with ground truth; labels are by depth where it is a `DepthDataset`.
        pipeline: a `Pipeline`, or the name of one of conf/pipeline. Its estimator is not used.
        overrides: changes of a named pipeline, as on the command line, e.g. ``["pruner=[one_to_one]"]``.
        root: the folder of such folders, by default ``matched`` in the cache folder.
        workers: threads, by default one a core. progress: called with (pairs done, pairs in all).
        augmentation, seed: as of `StoredMatches`.
        execution: other workers. build: makes a pipeline given as an object in other processes; pickled, as `dataset`.
        labels: pixels: by depth or the epipolar lines; geodesic: OANet's, for which the cameras must be known.

    Raises ValueError for an unknown pipeline, stages without a `configuration`, no pairs, and where every pair fails.

    Example:
        >>> from fmtorch.data import load
        >>> from fmtorch.training import Augmentation, MatchedPairs
        >>> rendered = load("rendered", split="train", size="full")  # doctest: +SKIP
        >>> matches = MatchedPairs(
        ...     rendered, "sift_ratio", overrides=["pruner=[one_to_one]"], augmentation=Augmentation()
        ... )  # doctest: +SKIP
    """

    def __init__(
        self, dataset: PairDataset, pipeline: Pipeline | str, *, overrides: Sequence[str] = (),
        root: str | Path | None = None, workers: int | None = None, progress: Progress | None = None,
        augmentation: labelled.Augmentation | None = None, seed: int = 0,
        execution: Execution | None = None, build: Callable[[], Pipeline] | None = None,
        labels: labelled.Rule = "pixels",
    ) -> None:  # fmt: skip
        if not len(dataset):
            raise ValueError(f"the data set {dataset.name} has no pairs")
        if (model := getattr(dataset, "model", "fundamental")) != "fundamental":
            what = f"the data set {dataset.name} has {model} matrices"
            raise ValueError(f"{what}; matches are labelled by fundamental ones")
        stages, execution = pipeline, execution or Execution("threads", workers)
        if isinstance(stages, str):
            build = build or functools.partial(load_pipeline, stages, overrides=tuple(overrides))
            stages = load_pipeline(stages, overrides=overrides)
        elif overrides:
            raise ValueError("overrides change a pipeline that is given by name; this one is given as an object")
        if build is None and not execution.shared:
            raise ValueError("other processes need to make the pipeline: give its name, or `build`")
        home = Path(root).expanduser() if root is not None else files.cache_dir() / "matched"
        identity = _identity(dataset, stages, labels)
        folder = home / f"{dataset.name}-{identity_digest(identity)[:16]}"
        files.claim(folder / "about.json", identity, "matches", "delete the folder", alone=False)
        pairs = [dataset[i] for i in range(len(dataset))]
        shards = [[pairs[i] for i in members] for members in partition(pairs)]
        jobs = [Job(folder / f"shard-{number:05d}.arrow", members) for number, members in enumerate(shards)]
        missing = [job for job in jobs if not _sound(job.path, len(job.pairs))]
        done, total = len(pairs) - sum(len(job.pairs) for job in missing), len(pairs)
        report = progress or (lambda done, total: None)
        report(done, total)
        for count in compute_shards(dataset, stages, build, missing, labels, execution):
            done += count
            report(done, total)
        super().__init__(folder, augmentation=augmentation, seed=seed)


def _identity(dataset: PairDataset, stages: Pipeline, rule: labelled.Rule) -> dict[str, Any]:
    extractor: Any = stages.extractor
    extractor = extractor.extractor if isinstance(extractor, CachedFeatures) else extractor
    families = [stages.families] if stages.families else []
    try:
        parts = configuration([extractor, stages.matcher, stages.pruners, *families])
    except TypeError as error:
        raise ValueError(f"the matches of this pipeline cannot be kept: {error}") from error
    rules: list[Any] = ["depth" if isinstance(dataset, DepthDataset) else "lines"]
    rules += [labelled.INLIER_PX, labelled.OUTLIER_PX, labelled.EDGE_PX]
    rules = rules if rule == "pixels" else [rule, oanet.GEODESIC]
    return {
        "format": FORMAT, "dataset": [dataset.name, dataset.digest], "most": MAX_MATCHES,
        "labels": [labelled.VERSION, *rules],
        "stages": parts, "environment": environment(),
    }  # fmt: skip


def stages_before_estimation(config: DictConfig) -> Pipeline:
    """The stages before estimation that a config names: features, matcher, and the pruners `before`, if any."""
    features = presets.instantiate(presets.plain(config.features), "features")
    extractor = cached(features, config.get("cache"), config.get("cache_limit"))
    before = {str(name): presets.build("pruner", str(name)) for name in config.get("before") or ()}
    matcher: Any = presets.instantiate(presets.plain(config.matcher), "matcher")
    return Pipeline(extractor, matcher, before, no_estimator)


def no_estimator(c: Any, seed: int = 0) -> Any:
    """What stands for the estimator of a pipeline that ends before it."""
    raise NotImplementedError("the stages before estimation only")


def _sound(path: Path, pairs: int) -> bool:
    if not path.exists():
        return False
    try:
        count = len(Shard(path, verify=True))
        if count == pairs:
            return True
        problem = f"{path} has {count} pairs instead of {pairs}"
    except ShardError as error:
        problem = str(error)
    warnings.warn(f"{problem}; it is computed anew", stacklevel=3)
    return False


def partition(pairs: Sequence[ImagePair]) -> list[list[int]]:
    """Indices of the pairs of each shard: at most `SHARD` of one scene, those that share images together."""
    names = [(p.family, p.scene, p.image0.identity, p.image1.identity) for p in pairs]
    order = sorted(range(len(pairs)), key=lambda i: (names[i], i))
    shards: list[list[int]] = []
    for i in order:
        if not shards or len(shards[-1]) == SHARD or names[shards[-1][-1]][:2] != names[i][:2]:
            shards.append([])
        shards[-1].append(i)
    return shards


class Job(NamedTuple):
    """A shard to compute: its file and its pairs."""

    path: Path
    pairs: list[ImagePair]


class Matching:
    """How pairs of a data set are matched, by the stages before estimation of a pipeline that is built, and labelled.
    labels: what they go by. images: whose features are kept."""

    def __init__(
        self, dataset: PairDataset, build: Callable[[], Pipeline], labels: labelled.Rule, images: int = _IMAGES
    ) -> None:
        stages = build()
        parts = stages.extractor, stages.matcher, stages.pruners, stages.estimator
        self.pipeline = Pipeline(*parts, device=stages.device, memory=images, families=stages.families)
        self.dataset, self.labels = dataset, labels

    def rows(self, job: Job) -> list[dict[str, Any]]:
        """The rows of a shard."""
        return [self._row(self.pipeline.correspondences([pair])[0]) for pair in job.pairs]

    def _row(self, outcome: Outcome) -> dict[str, Any]:
        """A pair as a row of a shard; a pair that fails has a reason and no matches."""
        pair, c = outcome.pair, outcome.correspondences
        row: dict[str, Any] = {
            "key": pair.key, "identity": pair.identity, "family": pair.family, "scene": pair.scene,
            "reason": outcome.reason, "matches": 0, "inliers": 0, "outliers": 0,
        }  # fmt: skip
        if c is None:
            return row
        c = _best(c.detach().to("cpu").compact())
        if not len(c.x0[0]):
            return {**row, "reason": "no matches are left"}
        x0, x1 = (x[0].to(torch.float64).numpy() for x in (c.x0.to(torch.float32), c.x1.to(torch.float32)))
        labels = labelled.label(self.dataset, pair, x0, x1, self.labels)
        norm = np.linalg.norm(pair.F) or 1.0  # zero where the pair determines none
        row |= {
            "matches": len(labels), "inliers": int((labels == 1).sum()), "outliers": int((labels == 0).sum()),
            "label": labels, "F": (pair.F / norm).ravel(),
        }  # fmt: skip
        for name, (kind, _) in ARRAYS.items():
            if name not in row and (x := getattr(c, name)) is not None:
                row[name] = x.to(getattr(torch, kind)).reshape(-1).numpy()
        return row


def compute_shards(
    dataset: PairDataset, stages: Pipeline, build: Callable[[], Pipeline] | None, jobs: Sequence[Job],
    labels: labelled.Rule, execution: Execution,
) -> Iterator[int]:  # fmt: skip
    """Write each job's shard; yields the number of its pairs when it is written.
    stages: the pipeline whose stages before estimation are run by threads; build: makes it in other processes, pickled.
    execution: by which workers, each with one thread of the libraries."""
    pool = WorkerPool(execution, PRELOADED)
    source: Source[Matching]
    if execution.shared:
        source = Local(Matching(dataset, lambda: stages, labels, _IMAGES * pool.size))
    else:
        assert build is not None
        source = Factory(functools.partial(Matching, dataset, build, labels))
    runner = TaskRunner(pool, source, Matching.rows, lambda job, rows: write_shard(job.path, rows))
    threads = torch.get_num_threads(), cv2.getNumThreads()
    use_one_thread()
    try:
        with pool:
            for job in runner.each(jobs):
                yield len(job.pairs)
    finally:  # interrupted: what is under way is finished and kept
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])


def _best(c: Correspondences) -> Correspondences:
    """The `MAX_MATCHES` least ambiguous matches of a single pair, in their order; the first if nothing ranks them."""
    n = c.x0.shape[1]
    if n <= MAX_MATCHES:
        return c
    rank = torch.arange(n) if c.ambiguity is None else torch.argsort(c.ambiguity[0], stable=True)
    kept = torch.zeros_like(c.mask)
    kept[0, rank[:MAX_MATCHES]] = True
    return c.keep(kept).compact()


# Files of OANet's layout

MAX_CAMERAS = 1 << 16  # pairs of a file whose cameras are kept once they were read, about a kilobyte each


class OANetShard(Shard):
    """A file of OANet's layout in the place of a shard."""

    def __init__(self, path: Path, labels: labelled.Rule, family: str) -> None:
        self.path, self.labels, self.family = path, labels, family
        self._access = oanet.RandomAccess(path)
        self._keys = oanet.keys(self._access.file)
        self._geometry = functools.lru_cache(MAX_CAMERAS)(functools.partial(_geometry, self._access))

    def __len__(self) -> int:
        return len(self._keys)

    def index(self) -> dict[str, list[Any]]:
        """As of `Shard`, without the counts of inliers and outliers, for which all would have to be read."""
        group, count, scene = self._access.file["xs"], len(self), self.path.stem
        identities = [f"{scene}/{key}" for key in self._keys]
        matches = [h5.shape(group, key)[-2:][0] for key in self._keys]
        reasons = ["" if n else f"{self.path}: 'xs/{key}' is empty" for n, key in zip(matches, self._keys, strict=True)]
        return {
            "key": [pair_key(identity) for identity in identities], "identity": identities,
            "family": [self.family] * count, "scene": [scene] * count, "reason": reasons, "matches": matches,
        }  # fmt: skip

    def read(self, row: int, names: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
        """The arrays of a pair; of these names alone, where that saves time.
        Raises DataError, naming file and key, for what is missing or damaged."""
        file, key = self._access.file, self._keys[row]
        if names and self.labels == "geodesic":
            label = self._geodesic(key, h5.shape(file["xs"], key)[-2:][0])
            ratio = oanet.figures(file, "ratios", key, len(label))
            return {"label": label} if ratio is None else {"label": label, "ratio": ratio.astype(np.float32)}
        cameras, F = self._geometry(key)
        (K0, K1), (size0, size1) = cameras.K, (np.array(size) for size in cameras.sizes)
        x0, x1, ratio, mutual = oanet.arrays(file, key, cameras)
        by_pixels = self.labels == "pixels"
        label = labelled.by_line(line_distance(F, x0, x1)) if by_pixels else self._geodesic(key, len(x0))
        values = {"x0": x0, "x1": x1, "ratio": ratio, "mutual": mutual, "label": label}
        known = {name: x.astype(ARRAYS[name][0]) for name, x in values.items() if x is not None}
        if not (np.isfinite(x0).all() and np.isfinite(x1).all()):
            inside = np.isfinite(x0).all(1) & np.isfinite(x1).all(1)
            known = {name: x[inside] for name, x in known.items()}
        return {**known, "F": F, "K0": K0, "K1": K1, "size0": size0, "size1": size1}

    def _geodesic(self, key: str, count: int) -> labelled.Labels:
        distance = oanet.figures(self._access.file, "ys", key, count)
        if distance is None:
            raise DataError(f"{self.path}: 'ys' is missing, which labels=geodesic needs; give labels=pixels")
        return labelled.by_geodesic(distance)


def _geometry(access: oanet.RandomAccess, key: str) -> tuple[oanet.Cameras, Matrix]:
    """The cameras of a pair and its F. Nine small entries take longer to read than the matches."""
    cameras = oanet.cameras(access.file, key)
    if not cameras.t.any():
        raise DataError(f"{access.path}: 'ts/{key}' is zero, which leaves no F")
    K0, K1 = cameras.K
    return cameras, fundamental(Camera(K0, np.eye(3), np.zeros(3)), Camera(K1, cameras.R, cameras.t))


class OANetPairs(StoredMatches):
    """The labelled matches of files of OANet's layout; each item is a batch of one pair, as of `StoredMatches`.

    A file is opened by each process for itself, and a pair is read when it is asked for. `pairs` says nothing of how
    many inliers there are. Coordinates are pixels: networks and losses with coordinates=K have the file's own.

    Args:
        root: a file, or a folder of some; each is a scene.
        labels: geodesic: a match is an inlier where the first column of ``ys`` is below 1e-4 (OANet); pixels: by its
            distance to the epipolar lines, as of `MatchedPairs`.
        before: pruners whose matches alone are given, each a function of correspondences.
        augmentation, seed: as of `StoredMatches`.

    Raises DataError, naming the file, for a file that is missing, damaged, empty or of another layout."""

    def __init__(
        self, root: str | Path, *, labels: labelled.Rule = "geodesic",
        augmentation: labelled.Augmentation | None = None, seed: int = 0,
        before: Sequence[Callable[[Correspondences], Correspondences]] = (),
    ) -> None:  # fmt: skip
        self.folder = Path(root).expanduser().resolve()
        self.labels, self.before = labels, list(before)
        self._read_index(h5.files(self.folder), augmentation, seed)
        if not self.pairs:
            raise DataError(f"{self.folder}: holds no pairs")

    def expect_ratios(self, remedy: str) -> None:
        """Raises DataError, naming the file, where one has no ratios."""
        for path in self._paths:
            with h5.opened(path) as file:
                if not h5.holds(file, "ratios"):
                    raise DataError(f"{path}: 'ratios' is missing; {remedy}")

    def _reader(self, path: Path) -> Shard:
        oanet_file = path.suffix in h5.SUFFIXES  # or a shard of a data set that was joined
        return OANetShard(path, self.labels, self.folder.stem) if oanet_file else super()._reader(path)

    @functools.cached_property
    def _contents(self) -> bytes:
        digest = hashlib.blake2b(f"{self.labels} {labelled.VERSION}".encode(), digest_size=16)
        for path in self._paths:
            h5.add_to_digest(digest, path)
        return digest.digest()

    @property
    def digest(self) -> str:
        """Of the files, the labels and which pairs there are."""
        keys = np.array([about["key"] for about in self.pairs]).tobytes()
        return hashlib.blake2b(self._contents + keys, digest_size=16).hexdigest()

    def stored(self, index: int) -> labelled.LabelledMatches:
        matches = super().stored(index)
        if not self.before:
            return matches
        c = matches.correspondences
        for pruner in self.before:
            c = pruner(c)
        return matches.replace(correspondences=c).compact()


class NamedPairs(PairDataset):
    """The pairs of `OANetPairs` by their names, without geometry."""

    name = "h5"

    def __init__(self, matches: OANetPairs) -> None:
        self.matches, self.digest = matches, matches.digest

    def __len__(self) -> int:
        return len(self.matches)

    def __getitem__(self, index: int) -> ImagePair:
        about = self.matches.pairs[index]
        image = predictions.image(about["family"], about["scene"], about["identity"], None)
        return ImagePair(about["identity"], about["family"], about["scene"], image, image, np.zeros((3, 3)))


def write_oanet(matches: StoredMatches, pairs: Iterable[ImagePair], folder: Path) -> list[Path]:
    """Write the matches of pairs of known cameras into a folder, a file of OANet's layout for each scene; the files."""
    cameras = {pair.key: pair for pair in pairs}
    scenes: dict[str, list[int]] = {}
    for i, about in enumerate(matches.pairs):
        scenes.setdefault(about["scene"], []).append(i)
    paths = [folder / f"{name.replace('/', '-')}.hdf5" for name in scenes]
    for path, members in zip(paths, scenes.values(), strict=True):
        oanet.write(path, (_entry(matches.stored(i), cameras[matches.pairs[i]["key"]]) for i in members))
    return paths


def _entry(matches: labelled.LabelledMatches, pair: ImagePair) -> Mapping[str, NDArray[Any] | None]:
    c = matches.correspondences
    ratios, mutuals = (None if values is None else values[0].numpy() for values in (c.ratio, c.mutual))
    x0, x1 = (x[0].numpy().astype(np.float64) for x in (c.x0, c.x1))
    if c.size0 is None or c.size1 is None or pair.K0 is None or pair.K1 is None or pair.R is None or pair.t is None:
        raise ValueError(f"OANet's layout needs cameras and image sizes, which pair {pair.identity} does not have")
    (h0, w0), (h1, w1) = c.size0[0].tolist(), c.size1[0].tolist()
    cameras = oanet.Cameras((pair.K0, pair.K1), pair.R, pair.t, ((h0, w0), (h1, w1)))
    return oanet.entry(cameras, x0, x1, ratios, mutuals)
