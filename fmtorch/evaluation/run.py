"""What makes a run: errors of each pair's F or homography, pose and focal lengths as rows, and the loop over batches.

Metrics are float64 and computed on the CPU: so little work needs no GPU. Threads share features and networks and start
at once, but only one of them issues torch operations at a time: enough where detectors, networks and OpenCV do the
work. Processes use all cores for estimators too, at seconds and hundreds of megabytes each. The caller alone writes."""

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from fmtorch import metrics, presets
from fmtorch.core.types import Correspondences, Estimate, collate
from fmtorch.data import GivenMatches, ImagePair, exif_focal
from fmtorch.io.match_store import MatchRecords, MatchStore
from fmtorch.io.oanet import GEODESIC, geodesic
from fmtorch.jit import kernel
from fmtorch.jobs import Execution, Factory, Local, Source, TaskRunner, WorkerPool
from fmtorch.pipeline import Outcome, Pipeline, examined, match_records
from fmtorch.pipeline.pipeline import STAGES
from fmtorch.runs import CachedFeatures, PairRow
from fmtorch.runs.fingerprint import code_digest, file_digest, fmtorch_version, learned, libraries
from fmtorch.two_view import pair_type
from fmtorch.two_view.arguments import Lens, lens_fields

LARGEST_ROTATION, LARGEST_TRANSLATION = 180.0, 90.0  # degrees: what a failed pair counts as, 180 with the sign of t
Figures = dict[str, Any]  # fields of `PairRow`


def evaluate(outcomes: Sequence[Outcome], seed: int = 0, signed: bool = False) -> list[PairRow]:
    """One row a pair. NSGD is 1 where the pipeline failed; an inlier rate is NaN where it is not defined.
    Pairs of known homographies have corner errors in place of NSGD and poses. signed: of `pose_errors`."""
    rows: dict[int, PairRow] = {}
    for planar in (False, True):
        index = [i for i, outcome in enumerate(outcomes) if (outcome.pair.H is not None) == planar]
        own = [outcomes[i] for i in index]
        start = time.perf_counter()
        figures = _of_homographies(own) if planar else _of_fundamental_matrices(own, seed, signed)
        seconds = (time.perf_counter() - start) / max(len(own), 1)
        rows |= {i: _row(o, each, planar, seconds) for i, o, each in zip(index, own, figures, strict=True)}
    return [rows[i] for i in range(len(outcomes))]


def _joined(outcomes: Sequence[Outcome]) -> tuple[Correspondences, Estimate, tuple[Tensor, Tensor]]:
    """Correspondences and estimates of outcomes that have both, as batches on the CPU, and the sizes of images."""
    c = collate([o.correspondences.to("cpu") for o in outcomes if o.correspondences is not None])
    if c.size0 is None or c.size1 is None:
        raise ValueError("correspondences come without image sizes (size0, size1); the matcher must supply them")
    return c, collate([o.estimate.to("cpu") for o in outcomes if o.estimate is not None]), (c.size0, c.size1)


def _truth(outcomes: Sequence[Outcome], *names: str) -> list[Tensor]:
    """What is true of each pair, by its names in `ImagePair`, float64."""
    values = ([np.asarray(getattr(o.pair, name), np.float64) for o in outcomes] for name in names)
    return [torch.from_numpy(np.stack(each)) for each in values]


def _matched(outcomes: Sequence[Outcome]) -> list[int]:
    return [i for i, o in enumerate(outcomes) if o.estimate is not None and o.correspondences is not None]


def _of_fundamental_matrices(outcomes: Sequence[Outcome], seed: int, signed: bool) -> list[Figures]:
    """NSGD in both forms, inlier rates before and, where the pair was solved, after estimation, and pose errors."""
    undefined = {"nsgd": 1.0, "nsgd_released": 1.0, "inlier_rate_before": math.nan, "inlier_rate": math.nan}
    figures: list[Figures] = [{**undefined} for _ in outcomes]
    if solved := [i for i, o in enumerate(outcomes) if o.solved]:
        own = [outcomes[i] for i in solved]
        (c, estimate, sizes), (F,) = _joined(own), _truth(own, "F")
        for name, distance in (("nsgd", metrics.nsgd), ("nsgd_released", metrics.nsgd_released)):
            values = distance(F, estimate.F, *sizes, seed=seed, key=c.keys).tolist()
            for i, value in zip(solved, values, strict=True):
                figures[i][name] = value
    if matched := _matched(outcomes):
        own = [outcomes[i] for i in matched]
        (c, estimate, sizes), (F,) = _joined(own), _truth(own, "F")
        rates = metrics.inlier_rate(F, c.x0, c.x1, estimate.inliers, *sizes, mask=c.mask)
        for i, before, after in zip(matched, rates.before.tolist(), rates.after.tolist(), strict=True):
            figures[i] |= {"inlier_rate_before": before, "inlier_rate": after if outcomes[i].solved else math.nan}
    poses = pose_errors(outcomes, signed)
    return [each | p | _by_labels(o) for each, p, o in zip(figures, poses, outcomes, strict=True)]


def _by_labels(outcome: Outcome) -> Figures:
    """Precision and recall of the estimator's inliers, of given matches of known cameras, zero where a pair failed.
    Right are those of a geodesic distance below 1e-4; recall is of all given matches, before pruning."""
    pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
    if pair.matches is None or _unknown(pair) is not None:
        return {}
    if c is None or estimate is None:
        return {"match_precision": 0.0, "match_recall": 0.0}
    kept = (estimate.inliers & c.mask)[0].cpu().numpy()
    right, total = _right(pair, c)[kept].sum(), _right(pair, pair.matches().correspondences).sum()
    return {"match_precision": float(right / max(kept.sum(), 1)), "match_recall": float(right / max(total, 1))}


def _right(pair: ImagePair, c: Correspondences) -> NDArray[np.bool_]:
    """Which matches (n,) of a batch of one have a geodesic distance below OANet's threshold."""
    K0, K1, R, t = (cast(NDArray[np.float64], value) for value in (pair.K0, pair.K1, pair.R, pair.t))
    distance = geodesic(R, t, K0, K1, *(x[0].double().cpu().numpy() for x in (c.x0, c.x1)))
    right: NDArray[np.bool_] = (distance < GEODESIC) & c.mask[0].cpu().numpy()
    return right


def _of_homographies(outcomes: Sequence[Outcome]) -> list[Figures]:
    """Corner errors in pixels, infinite where a pair failed, and the shares of right matches, NaN if undefined."""
    rates = {"inlier_rate_before": math.nan, "inlier_rate": math.nan}
    figures: list[Figures] = [{"nsgd": math.nan, "corner_error": math.inf, **rates} for _ in outcomes]
    if matched := _matched(outcomes):
        own = [outcomes[i] for i in matched]
        (c, estimate, (size0, _)), (H,) = _joined(own), _truth(own, "H")
        errors = torch.where(estimate.ok, metrics.corner_error(estimate.H, H, size0), torch.inf)
        right, kept = metrics.right_of_homography(H, c.x0, c.x1, mask=c.mask), estimate.inliers & c.mask
        before = right.sum(-1).double() / c.mask.sum(-1)
        after = torch.where(estimate.ok, (right & kept).sum(-1).double() / kept.sum(-1), torch.nan)
        for i, error, a, b in zip(matched, errors.tolist(), before.tolist(), after.tolist(), strict=True):
            figures[i] |= {"corner_error": error, "inlier_rate_before": a, "inlier_rate": b}
    return figures


def _row(outcome: Outcome, figures: Figures, planar: bool, seconds: float) -> PairRow:
    pair, c, estimate = outcome.pair, outcome.correspondences, outcome.estimate
    ok, pair_type = outcome.solved, outcome.pair_type
    lenses = (None, None, None) if estimate is None else _lenses(estimate)
    matrix = estimate.matrix[0].flatten().tolist() if estimate is not None and ok else None
    figures = figures | {f"seconds_{stage}": outcome.seconds.get(stage, math.nan) for stage in STAGES}
    return PairRow(
        pair=pair.identity, key=pair.key, family=pair.family, scene=pair.scene, ok=ok, reason=outcome.reason,
        corrs=int(estimate.inliers.sum()) if estimate is not None else 0,
        corrs_before=int(c.mask.sum()) if c is not None else 0,
        features0=outcome.features[0], features1=outcome.features[1],
        samples=int(estimate.samples[0]) if estimate is not None else 0,
        seconds_metrics=seconds, F=None if planar else matrix, H=matrix if planar else None, **figures,
        significance=float(cast(Tensor, estimate.significance)[0]) if estimate is not None and ok else None,
        related=bool(estimate.related[0]) if estimate is not None else False,
        pair_type=None if pair_type is None else pair_type.names[0],
        warning=outcome.not_examined or None if pair_type is None else pair_type.warnings[0],
        **focal_errors(outcome), lens_suggested=lenses[0], lens0=lenses[1], lens1=lenses[2],
    )  # fmt: skip


def _lenses(estimate: Estimate) -> list[float | None]:
    """Lambda of the lens that is suggested, and of those that are estimated; None where not determined."""
    unknown = [math.nan, math.nan]
    suggested = [math.nan] if estimate.lens_suggested is None else estimate.lens_suggested.tolist()
    values = suggested + (unknown if estimate.lens is None else estimate.lens[0].tolist())
    return [None if math.isnan(value) else value for value in values]


def pose_errors(outcomes: Sequence[Outcome], signed: bool = False) -> list[Figures]:
    """The pose error of each pair: of the estimate's R and t, or else of its F, K0, K1 and the estimator's inliers.
    See `pose_error` and `fundamental_pose_error`. A pair without F, or without a pose, has the largest errors and a
    reason; one whose calibration or motion is unknown has a reason only. signed: the sign of the translation counts,
    and of the four poses of F the best one: `closest_pose_error`."""
    poses = [Figures(pose_reason=_unknown(outcome.pair)) for outcome in outcomes]
    known = [i for i, pose in enumerate(poses) if pose["pose_reason"] is None]
    solved = [i for i in known if outcomes[i].solved]
    of_F = "F has no pose" if signed else "no inlier in front of both cameras"
    for estimated, reason in ((True, "the pose is not determined"), (False, of_F)):
        own = [i for i in solved if (cast(Estimate, outcomes[i].estimate).R is not None) == estimated]
        error = _pose_error([outcomes[i] for i in own], signed) if own else ([], [])
        for i, rotation, translation in zip(own, *error, strict=True):
            poses[i] |= {"rotation_error": rotation, "translation_error": translation}
            poses[i]["pose_reason"] = reason if rotation >= LARGEST_ROTATION else None
    largest = LARGEST_ROTATION if signed else LARGEST_TRANSLATION
    lost = {"rotation_error": LARGEST_ROTATION, "translation_error": largest, "pose_reason": "no F"}
    return [lost if i in known and not outcomes[i].solved else pose for i, pose in enumerate(poses)]


def _unknown(pair: ImagePair) -> str | None:
    values = {"K0": pair.K0, "K1": pair.K1, "R": pair.R, "t": pair.t}
    if missing := [name for name, value in values.items() if value is None]:
        return f"{', '.join(missing)} unknown"
    broken = [name for name, value in values.items() if not np.isfinite(cast(NDArray[np.float64], value)).all()]
    return f"{', '.join(broken)} not finite" if broken else None


def _pose_error(outcomes: Sequence[Outcome], signed: bool) -> tuple[list[float], list[float]]:
    """Rotation and translation errors: of the estimates' R and t where they have some, else of their F."""
    (c, estimate, _), (K0, K1, R, t) = _joined(outcomes), _truth(outcomes, "K0", "K1", "R", "t")
    if estimate.R is not None and estimate.t is not None:
        error = metrics.pose_error(estimate.R.double(), estimate.t.double(), R, t, up_to_sign=not signed)
    elif signed:
        error = metrics.closest_pose_error(estimate.F.double(), K0, K1, R, t)
    else:
        inliers = estimate.inliers & c.mask
        error = metrics.fundamental_pose_error(estimate.F.double(), K0, K1, c.x0, c.x1, R, t, inliers)
    return error.rotation.tolist(), error.translation.tolist()


def focal_errors(outcome: Outcome) -> Figures:
    """Of both images ``|f - f_true| / f_true`` and ``log(f / f_true)``, by what the estimator was given of the pair.
    None of these where no focal length was estimated, since it was given exactly or nobody asked, or the true one is
    not known. Where it was to be estimated and is not determined the error is infinite and there is no ratio."""
    c, estimate, figures = outcome.correspondences, outcome.estimate, Figures()
    for i, K in enumerate((outcome.pair.K0, outcome.pair.K1)):
        true = _focal(K)
        if estimate is None or c is None or c.focal is None or true is None or float(c.focal[0, i, 1]) == 0:  # exact
            continue
        focal = math.nan if estimate.focals is None or not outcome.solved else float(estimate.focals[0, i])
        figures[f"focal_error{i}"] = math.inf
        if math.isfinite(focal) and focal > 0:
            figures |= {f"focal_error{i}": abs(focal - true) / true, f"focal_log_ratio{i}": math.log(focal / true)}
    return figures


def _focal(K: NDArray[np.float64] | None) -> float | None:
    """The focal length of a calibration, px: the geometric mean of those along x and y."""
    if K is None or not np.isfinite(K).all():
        return None
    product = float(K[0, 0] * K[1, 1]) / float(K[2, 2]) ** 2 if K[2, 2] else 0.0
    return math.sqrt(product) if product > 0 else None


PLACES = ("root", "file", "truth", "images")  # options that say where a data set lies; its digest says what it is


def run_identity(
    config: DictConfig, pipeline_name: str, pipeline: Pipeline, dataset_digest: str, cameras: str | None = None,
    signed: bool = False, lens: Lens | Literal["known"] = None,
) -> dict[str, Any]:  # fmt: skip
    """The identity of a run, as plain values.

    Args:
        config: a composed config: stages, data set, seed. pipeline_name: the preset that it began with.
        pipeline: what was built of the config. dataset_digest: of the contents of the data set.
        cameras, lens: what the estimator is given of them; None: nothing. signed: whether the sign of t counts.

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
        "libraries": libraries(presets.files.peer_packages(stages)), "kernels": kernel.identity(),
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
    for target, module in presets.files.own_modules(config).items():
        try:
            digests[target] = code_digest(module)
        except (TypeError, KeyError, OSError):
            digests[target] = "in no file"
    return digests


Cameras = Literal["known", "shared", "exif", "unknown"]
UNKNOWN, EXACT = (1.0, math.inf), (1.0, 0.0)  # px, relative deviation; K stands for the pixels of an exact one


def informed(
    pairs: Sequence[ImagePair], cameras: Cameras | None, lens: Lens | Literal["known"] = None
) -> list[ImagePair]:
    """The pairs with what estimators are given of their cameras and lenses.
    cameras: known: their calibrations; exif: the focal lengths in the files of their images, unknown where there are
    none; shared: that both images of a pair are of one camera; unknown: nothing; None: they are not asked for. lens: as
    of `find_fundamental`, or known: the data set's; where it is given, images are read as photographed.
    Raises ValueError for cameras that are known where a pair has no calibration."""
    of_lens, measured = {} if lens == "known" else lens_fields(lens), functools.cache(_measured)

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

    def given(pair: ImagePair) -> ImagePair:
        if lens is not None:
            image0, image1 = (dataclasses.replace(i, as_photographed=True) for i in (pair.image0, pair.image1))
            pair = dataclasses.replace(pair, image0=image0, image1=image1)
        return dataclasses.replace(pair, given=fields(pair))

    asked = cameras is not None or lens is not None
    return [given(pair) if asked and pair.problem is None else pair for pair in pairs]


def _measured(path: Path) -> tuple[float, float]:
    exif = exif_focal(path)
    return (exif.focal, exif.deviation) if exif.known else UNKNOWN


class Batch(NamedTuple):
    """Pairs to evaluate. export: whether keypoints, matches and F are to be exported. signed: of `pose_errors`."""

    pairs: list[ImagePair]
    seed: int
    export: bool = False
    signed: bool = False


class Work(NamedTuple):
    """The rows of a batch.
    computed, from_cache: images whose features a process computed or had for it. tracebacks: `Pipeline.tracebacks`."""

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
    execution: by which workers. build: makes the same pipeline in another process, where these are no threads. journal:
    keeps keypoints, matches and F for an export. signed: of `pose_errors`. Rows and journal are written here. Results
    do not depend on `batch` or `execution`. Raises WorkersLost as `TaskRunner.each`."""
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

    def given_up(done: Batch, reason: str) -> None:
        store(evaluate([Outcome(pair, reason=reason) for pair in done.pairs], seed, signed))

    runner = TaskRunner(pool, source, evaluate_batch, keep, given_up, divided)
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
