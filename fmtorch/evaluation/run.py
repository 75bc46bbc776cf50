"""The loop that makes a run: batches of pairs through a pipeline by several workers, rows stored as they come.

Threads share features and networks and start at once, but only one of them issues torch operations at a time: enough
where detectors, networks and OpenCV do the work. Processes use all cores for estimators too, at some seconds and some
hundred megabytes each. Rows and exports come back to the caller, who alone writes.
"""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from fmtorch import presets
from fmtorch.data import GivenMatches, ImagePair, exif_focal
from fmtorch.evaluation.rows import evaluate
from fmtorch.io.match_store import MatchRecords, MatchStore
from fmtorch.jit import kernel
from fmtorch.jobs import Execution, Factory, Local, Source, TaskRunner, WorkerPool
from fmtorch.pipeline import Outcome, Pipeline, examined, match_records
from fmtorch.runs import CachedFeatures, PairRow
from fmtorch.runs.fingerprint import code_digest, file_digest, fmtorch_version, learned, libraries
from fmtorch.two_view import pair_type
from fmtorch.two_view.arguments import Lens, lens_fields

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


def informed(pairs: Sequence[ImagePair], cameras: Cameras | None, lens: Lens = None) -> list[ImagePair]:
    """The pairs with what estimators are given of their cameras and lenses.
    cameras: known: their calibrations; exif: the focal lengths in the files of their images, unknown where there are
    none; shared: that both images of a pair are of one camera; unknown: nothing; None: they are not asked for. lens: as
    of `find_fundamental`. Raises ValueError for `known` where a pair has no calibration."""
    of_lens, measured = lens_fields(lens), functools.cache(_measured)

    def fields(pair: ImagePair) -> dict[str, Tensor | None]:
        if cameras is None:
            return of_lens
        K: tuple[Tensor | None, Tensor | None] = (None, None)
        focals = [UNKNOWN, UNKNOWN]
        if cameras == "exif":
            focals = [measured(image.path) for image in (pair.image0, pair.image1)]
        elif cameras == "known":
            if pair.K0 is None or pair.K1 is None:
                lacks = f"the data set has no calibration of pair {pair.identity}"
                raise ValueError(f"cameras=known, but {lacks}; give another")
            K, focals = (torch.from_numpy(pair.K0).double(), torch.from_numpy(pair.K1).double()), [EXACT, EXACT]
        focal, shared = torch.tensor(focals, dtype=torch.float64), torch.tensor(cameras == "shared")
        return {"K0": K[0], "K1": K[1], "focal": focal, "shared_focal": shared, **of_lens}

    asked = cameras is not None or lens is not None
    return [dataclasses.replace(p, given=fields(p)) if asked and p.problem is None else p for p in pairs]


def _measured(path: Path) -> tuple[float, float]:
    exif = exif_focal(path)
    return (exif.focal, exif.deviation) if exif.known else UNKNOWN


class Batch(NamedTuple):
    """Pairs to evaluate.
    export: whether keypoints, matches and F are to be exported. signed: of `pose_errors`."""

    pairs: list[ImagePair]
    seed: int
    export: bool = False
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
    cache = pipeline.extractor if isinstance(pipeline.extractor, CachedFeatures) else None
    computed, from_cache = (cache.computed, cache.found) if cache else (0, 0)
    outcomes = examined(pipeline, pipeline.run(batch.pairs, batch.seed), batch.seed)
    records = match_records(pipeline, outcomes) if batch.export else None
    rows = evaluate(outcomes, batch.seed, batch.signed)
    counts = (cache.computed - computed, cache.found - from_cache) if cache else (0, 0)
    return Work(rows, *counts, records, dict(pipeline.tracebacks))


def divided(batch: Batch) -> list[Batch]:
    """The pairs of a batch in batches of their own."""
    return [batch._replace(pairs=[pair]) for pair in batch.pairs]


def failed(batch: Batch, reason: str) -> list[PairRow]:
    """The rows of pairs that no worker lives to evaluate."""
    return evaluate([Outcome(pair, reason=reason) for pair in batch.pairs], batch.seed, batch.signed)


def with_contents(pairs: Sequence[ImagePair]) -> list[ImagePair]:
    """The pairs with their images as bytes, each read once, or their given matches; what fails the worker will tell."""
    held = functools.cache(Path.read_bytes)

    def sent(pair: ImagePair) -> ImagePair:
        if pair.matches is not None:
            return dataclasses.replace(pair, matches=functools.partial(GivenMatches._make, pair.matches()))
        image0, image1 = (dataclasses.replace(i, data=held(i.path)) for i in (pair.image0, pair.image1))
        return dataclasses.replace(pair, image0=image0, image1=image1)

    result = list(pairs)
    for i, pair in enumerate(pairs):
        if pair.problem is None:
            with contextlib.suppress(Exception):
                result[i] = sent(pair)
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
    store: Callable[[list[PairRow]], None], build: Callable[[], Pipeline] | None = None,
    journal: MatchStore | None = None, signed: bool = False,
) -> Iterator[int]:  # fmt: skip
    """Run and evaluate the pairs, hand each batch's rows to `store`, and yield how many pairs it held.
    execution: by which workers. build: makes the same pipeline in another process, where these are no threads.
    journal: keeps keypoints, matches and F for an export. signed: of `pose_errors`. Rows and journal are written here.
    Results do not depend on `batch` or `execution`. Raises WorkersLost where workers die whatever they do, or a
    scheduler is gone."""
    pool = WorkerPool(execution, PRELOADED, limit=max(1, len(pairs)))
    if pool.size > 1:  # no one of several workers shall be long alone at the end
        batch = max(1, min(batch, -(-len(pairs) // (BATCHES_OF_A_WORKER * pool.size))))
    source: Source[Pipeline] = Local(pipeline) if execution.shared or build is None else Factory(build)

    def given(members: Sequence[ImagePair]) -> Batch:
        sent = with_contents(members) if execution.send_images and not source.shared else list(members)
        return Batch(sent, seed, journal is not None, signed)

    def keep(done: Batch, work: Work) -> None:
        if journal is not None and work.records is not None:
            journal.add(work.records)
        store(work.rows)
        pipeline.tracebacks |= work.tracebacks
        if isinstance(pipeline.extractor, CachedFeatures) and not source.shared:
            pipeline.extractor.computed += work.computed
            pipeline.extractor.found += work.from_cache

    runner = TaskRunner(pool, source, evaluate_batch, keep, lambda done, reason: store(failed(done, reason)), divided)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with pool:
            if execution.shared:  # by one worker, while the others compute features
                pool.executor.submit(pair_type.compile_with, [*pipeline.pruners.values(), pipeline.estimator])
            for done in runner.each(given(pairs[i : i + batch]) for i in range(0, len(pairs), batch)):
                yield len(done.pairs)
    finally:
        torch.set_num_threads(before)
