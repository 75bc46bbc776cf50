"""The loop that makes a run: batches of pairs through a pipeline by several workers, rows stored as they come.

Threads share features and networks and start at once, but only one of them issues torch operations at a time: enough
where detectors, networks and OpenCV do the work. Processes use all cores for estimators too, at some seconds and some
hundred megabytes each. Rows and exports come back to the caller, who alone writes.
"""

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from fmtorch import presets
from fmtorch.core.stages import Estimator, ImageMatcher
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import GivenMatches, ImagePair, ImageSource, exif_focal
from fmtorch.evaluation.rows import evaluate
from fmtorch.io.match_store import MatchRecords, MatchStore
from fmtorch.jit import kernel
from fmtorch.jobs import Execution, Factory, Local, Source, TaskRunner, WorkerPool
from fmtorch.pipeline import Outcome, Pipeline, examined, match_records
from fmtorch.runs import CachedFeatures, PairRow
from fmtorch.runs.fingerprint import code_digest, file_digest, fmtorch_version, learned, libraries
from fmtorch.two_view import known_cameras, pair_type
from fmtorch.two_view.arguments import Lens, expect_lenses, lens_fields

PLACES = ("root", "file", "truth", "images")
"""Options of data sets that say where things lie; the digest says what they are."""


def run_identity(
    config: DictConfig, pipeline_name: str, pipeline: Pipeline, dataset_digest: str, cameras: str | None = None,
    signed: bool = False, lens: Lens = None,
) -> dict[str, Any]:  # fmt: skip
    """The identity of a run, as plain values.

    Args:
        config: a composed config: stages, data set, seed. pipeline_name: the preset that it began with.
        pipeline: what was built of the config. dataset_digest: of the contents of the data set.
        cameras, lens: what the estimator is given of them; None: nothing. signed: whether the sign of a translation
            counts.

    Returns:
        `pipeline`, each stage's config (pruners as a list), `seed`; `version` of fmtorch, in a checkout its commit;
        `libraries`: their versions; `kernels`: by which numba, or off; `learned`: digests of each stage's learned
        files; `code`: digests of the sources of parts of the user's own; `dataset`: its config, without where it lies,
        and its digest; `cameras` and `lens`, where they are given; `pose`, where translations are signed.
    """
    stages = presets.stages(config)
    dataset = {key: value for key, value in presets.plain(config.dataset).items() if key not in PLACES}
    dataset["digest"] = dataset_digest
    return {
        "pipeline": pipeline_name, **stages, "seed": config.seed, "version": fmtorch_version(),
        "libraries": libraries(presets.peer_packages(stages)), "kernels": kernel.identity(),
        "learned": _learned(stages, pipeline),
        "code": _code({"stages": stages, "dataset": dataset}), "dataset": dataset,
        **({} if cameras is None else {"cameras": cameras}), **({} if lens is None else {"lens": lens}),
        **({"pose": {"signed": True}} if signed else {}),
    }  # fmt: skip


def _learned(stages: Mapping[str, Any], pipeline: Pipeline) -> dict[str, list[str]]:
    extractor = pipeline.extractor
    parts: dict[str, list[object]] = {
        "features": [extractor.extractor if isinstance(extractor, CachedFeatures) else extractor],
        "matcher": [pipeline.matcher], "estimator": [pipeline.estimator],
        "pruner": [p for pruners in (pipeline.pruners, *pipeline.families.values()) for p in pruners.values()],
    }  # fmt: skip
    digests = {
        group: {*(digest for part in parts[group] for digest in learned(part)), *_files(stages.get(group))}
        for group in presets.STAGES
    }
    return {group: sorted(digests_of_group) for group, digests_of_group in digests.items() if digests_of_group}


def _files(config: object, option: str = "") -> Iterator[str]:
    """Digests of the files that options name: a part that does not say what defines it may well read them."""
    if isinstance(config, Mapping):
        for key, value in config.items():
            yield from _files(value, str(key))
    elif isinstance(config, list):
        for value in config:
            yield from _files(value, option)
    elif isinstance(config, str) and option != "_target_" and Path(config).suffix:
        path = Path(config).expanduser()
        with contextlib.suppress(OSError, ValueError):
            if path.is_file():
                yield file_digest(path)


def _code(config: object) -> dict[str, str]:
    digests = {}
    for target, module in presets.own_modules(config).items():
        try:
            digests[target] = code_digest(module)
        except (TypeError, KeyError, OSError):
            digests[target] = "in no file"
    return digests


Cameras = Literal["known", "shared", "exif", "unknown"]
UNKNOWN, EXACT = (1.0, math.inf), (1.0, 0.0)  # px, relative deviation; K stands for the pixels of an exact one


class PairCameras(NamedTuple):
    """What an estimator is given of a pair, fields of `Correspondences`: K0, K1 (3, 3), focal (2, 2), shared_focal."""

    K0: Tensor | None
    K1: Tensor | None
    focal: Tensor
    shared_focal: bool


def cameras_of(pairs: Sequence[ImagePair], cameras: Cameras) -> dict[int, PairCameras]:
    """What is known of the cameras of pairs, by their keys.
    known: their calibrations. exif: the focal lengths in the files of their images, unknown where there are none.
    shared: that both images of a pair are of one camera. unknown: nothing. Raises ValueError for `known` where a pair
    has no calibration."""
    if cameras == "known":
        return {pair.key: _calibrated(pair) for pair in pairs if pair.problem is None}
    if cameras == "exif":
        measured = functools.cache(_measured)
        ends = ((pair.key, [measured(image.path) for image in (pair.image0, pair.image1)]) for pair in pairs)
        return {key: PairCameras(None, None, _two(*focals), False) for key, focals in ends}
    nothing = PairCameras(None, None, _two(UNKNOWN, UNKNOWN), cameras == "shared")
    return {pair.key: nothing for pair in pairs}


def _calibrated(pair: ImagePair) -> PairCameras:
    if pair.K0 is None or pair.K1 is None:
        raise ValueError(f"cameras=known, but the data set has no calibration of pair {pair.identity}; give another")
    K0, K1 = (torch.from_numpy(K).to(torch.float64) for K in (pair.K0, pair.K1))
    return PairCameras(K0, K1, _two(EXACT, EXACT), False)


def _measured(path: Path) -> tuple[float, float]:
    exif = exif_focal(path)
    return (exif.focal, exif.deviation) if exif.known else UNKNOWN


def _two(first: tuple[float, float], second: tuple[float, float]) -> Tensor:
    return torch.tensor([first, second], dtype=torch.float64)


class WithPairCameras:
    """An estimator that is given the cameras of each pair, which it finds by the pairs' keys, or a lens, or both."""

    model = "fundamental"

    def __init__(self, estimator: Estimator, cameras: Mapping[int, PairCameras] | None, lens: Lens = None) -> None:
        """cameras: of `cameras_of`, of all pairs that will come; or they are added before their pairs come; None:
        nothing is given of them. lens: as of `find_fundamental`."""
        self._estimator = known_cameras.KnownCameras(estimator)
        self.cameras, self._lens = None if cameras is None else dict(cameras), lens_fields(lens)

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate:
        estimator = self._estimator.estimator if self.cameras is None else self._estimator
        return estimator(self.given(c), seed)

    @property
    def kernels(self) -> Sequence[object]:
        return getattr(self._estimator.estimator, "kernels", ())

    def given(self, c: Correspondences) -> Correspondences:
        lens = {name: value.to(c.mask.device).expand(len(c), *value.shape) for name, value in self._lens.items()}
        c = c.derived(**lens)
        if self.cameras is None:
            return c
        K0, K1, focal, shared = zip(*[self.cameras[key] for key in c.keys.tolist()], strict=True)
        stacked = [None if K[0] is None else torch.stack(K).to(c.mask.device) for K in (K0, K1, focal)]  # all, or none
        fields = dict(zip(("K0", "K1", "focal"), stacked, strict=True))
        return c.derived(**fields, shared_focal=torch.tensor(shared, device=c.mask.device))


def built_with(
    build: Callable[[], Pipeline], cameras: Mapping[int, PairCameras] | None, lens: Lens = None
) -> Pipeline:  # fmt: skip
    """A pipeline whose estimator is given the cameras of each pair, and what is known of lenses."""
    pipeline = build()
    if lens is not None:
        expect_lenses(pipeline.estimator, type(pipeline.estimator).__name__)
    pipeline.estimator = WithPairCameras(pipeline.estimator, cameras, lens)
    return pipeline


Build = Callable[[], Pipeline]


class Batch(NamedTuple):
    """Pairs to evaluate.
    cameras: of their keys, for a pipeline that was built without them. export: whether keypoints, matches and F are to
    be exported. counted: whether the worker counts the images that it computed. signed: of `pose_errors`."""

    pairs: list[ImagePair]
    seed: int
    cameras: Mapping[int, PairCameras] | None = None
    export: bool = False
    counted: bool = False
    signed: bool = False


class Work(NamedTuple):
    """The rows of a batch.
    computed, from_cache: images whose features a process computed or took from the cache for it. tracebacks: of
    `Pipeline.tracebacks`."""

    rows: list[PairRow]
    computed: int = 0
    from_cache: int = 0
    records: MatchRecords | None = None
    tracebacks: Mapping[str, str] = {}


def evaluate_batch(pipeline: Pipeline, batch: Batch) -> Work:
    """The rows of a batch, and what is to be exported of it."""
    cache = pipeline.extractor if batch.counted and isinstance(pipeline.extractor, CachedFeatures) else None
    computed, from_cache = (cache.computed, cache.found) if cache else (0, 0)
    informed = pipeline.estimator if isinstance(pipeline.estimator, WithPairCameras) else None
    if batch.cameras is not None:
        assert informed is not None
        assert informed.cameras is not None
        informed.cameras |= batch.cameras
    pair_type.compile_with([*pipeline.pruners.values(), pipeline.estimator])
    knowledge = None if informed is None else informed.given
    outcomes = examined(pipeline, pipeline.run(batch.pairs, batch.seed), batch.seed, knowledge)
    records = match_records(pipeline, outcomes) if batch.export else None
    rows = evaluate(outcomes, batch.seed, batch.signed)
    if informed is not None and informed.cameras is not None:
        for key in batch.cameras or ():
            informed.cameras.pop(key, None)
    counts = (cache.computed - computed, cache.found - from_cache) if cache else (0, 0)
    return Work(rows, *counts, records, dict(pipeline.tracebacks))


def divided(batch: Batch) -> list[Batch]:
    """The pairs of a batch in batches of their own."""
    return [batch._replace(pairs=[pair]) for pair in batch.pairs]


def failed(batch: Batch, reason: str) -> list[PairRow]:
    """The rows of pairs that no worker lives to evaluate."""
    return evaluate([Outcome(pair, reason=reason) for pair in batch.pairs], batch.seed, batch.signed)


def compute_features(pipeline: Pipeline, image: ImageSource) -> None:
    """Have an image's features computed for the pipeline to keep; its pairs will tell what that raises."""
    with contextlib.suppress(Exception):
        pipeline.features(image)


def with_contents(pair: ImagePair) -> ImagePair:
    """The pair with its images as bytes, or its given matches read; what cannot be read the worker will tell."""
    if pair.problem is not None:
        return pair
    with contextlib.suppress(Exception):
        if pair.matches is not None:
            return dataclasses.replace(pair, matches=functools.partial(_read, pair.matches()))
        images = (dataclasses.replace(image, data=image.path.read_bytes()) for image in (pair.image0, pair.image1))
        return dataclasses.replace(pair, image0=next(images), image1=next(images))
    return pair


def _read(matches: GivenMatches) -> GivenMatches:
    return matches


def batch_contents(pairs: list[ImagePair]) -> list[ImagePair]:
    """`with_contents` of each pair; an image that several show is read, and sent, once."""
    held: dict[Path, bytes | None] = {}
    result = []
    for pair in pairs:
        own = with_contents(pair)
        images = [
            image if image.data is None else dataclasses.replace(image, data=held.setdefault(image.path, image.data))
            for image in (own.image0, own.image1)
        ]
        result.append(dataclasses.replace(own, image0=images[0], image1=images[1]))
    return result


BATCHES_OF_A_WORKER = 4  # at least, where there are pairs enough
PRELOADED = (__name__,)  # by the process that workers are forked of


def select(pairs: Sequence[ImagePair], limit: int | None) -> list[ImagePair]:
    """The pairs, ordered so that those that share images follow one another; with a limit, that many of each family.
    The limited choice is by the pairs' keys: spread over the scenes, and a smaller one is part of a larger one."""
    chosen = list(pairs)
    if limit is not None:
        families: dict[str, list[ImagePair]] = {}
        for pair in sorted(chosen, key=lambda pair: pair.key):
            families.setdefault(pair.family, []).append(pair)
        chosen = [pair for family in families.values() for pair in family[:limit]]
    return sorted(chosen, key=lambda pair: (pair.family, pair.scene, pair.image0.identity, pair.image1.identity))


def evaluate_pairs(
    pipeline: Pipeline, pairs: Sequence[ImagePair], *, seed: int, batch: int, execution: Execution,
    store: Callable[[list[PairRow]], None], build: Build | None = None,
    cameras: Mapping[int, PairCameras] | None = None, journal: MatchStore | None = None, signed: bool = False,
) -> Iterator[int]:  # fmt: skip
    """Run and evaluate the pairs, hand each batch's rows to `store`, and yield how many pairs it held.
    execution: by which workers. build: makes the same pipeline in another process, where these are no threads. cameras:
    what a pipeline that `build` makes is given of the pairs' cameras, see `built_with`. journal: keeps keypoints,
    matches and F for an export. signed: of `pose_errors`. Rows and journal are written here. Results do not depend on
    `batch` or `execution`. Raises WorkersLost where workers die whatever they do, or a scheduler is gone."""
    pool = WorkerPool(execution, PRELOADED, limit=max(1, len(pairs)))
    if pool.size > 1:  # no one of several workers shall be long alone at the end
        batch = max(1, min(batch, -(-len(pairs) // (BATCHES_OF_A_WORKER * pool.size))))
    source: Source[Pipeline] = Local(pipeline) if execution.shared or build is None else Factory(build)

    def given(members: Sequence[ImagePair]) -> Batch:
        own = None if cameras is None or source.shared else {p.key: cameras[p.key] for p in members if p.key in cameras}
        sent = batch_contents(list(members)) if execution.send_images and not source.shared else list(members)
        return Batch(sent, seed, own, journal is not None, not source.shared, signed)

    def keep(done: Batch, work: Work) -> None:
        if journal is not None and work.records is not None:
            journal.add(work.records)
        store(work.rows)
        pipeline.tracebacks |= work.tracebacks
        if isinstance(pipeline.extractor, CachedFeatures):
            pipeline.extractor.computed += work.computed
            pipeline.extractor.found += work.from_cache

    runner = TaskRunner(pool, source, evaluate_batch, keep, lambda done, reason: store(failed(done, reason)), divided)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with pool:
            begun = 0
            if source.shared and pool.size > 1 and pairs and not isinstance(pipeline.matcher, ImageMatcher):
                begun = 1  # alone: where its stages compile kernels, others would wait for them
                _features_ahead(pool, pipeline, pairs, runner.begin(given(pairs[:1])))
            for done in runner.each(given(pairs[i : i + batch]) for i in range(begun, len(pairs), batch)):
                yield len(done.pairs)
    finally:
        torch.set_num_threads(before)


def _features_ahead(pool: WorkerPool, pipeline: Pipeline, pairs: Sequence[ImagePair], first: Future[Work]) -> None:
    """While a worker is at the first pair, the others compute features of those that follow, as many as are kept."""
    computing: set[Future[None]] = set()
    for image in itertools.islice(_images_after_the_first(pairs), pipeline.memory):
        while len(computing) >= pool.size - 1 and not first.done():
            wait(list[Future[Any]]([first, *computing]), return_when=FIRST_COMPLETED)
            computing = {future for future in computing if not future.done()}
        if first.done():
            return
        computing.add(pool.executor.submit(compute_features, pipeline, image))


def _images_after_the_first(pairs: Sequence[ImagePair]) -> Iterator[ImageSource]:
    seen = {pairs[0].image0.pixels, pairs[0].image1.pixels}
    for pair in pairs[1:]:
        if pair.problem is None and pair.matches is None:
            for image in (pair.image0, pair.image1):
                if image.pixels not in seen:
                    seen.add(image.pixels)
                    yield image
