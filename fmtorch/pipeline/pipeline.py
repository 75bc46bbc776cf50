"""The four stages in a row: features, matching, pruning, estimation; batching, timing, failures as data."""

import dataclasses
import functools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from hydra.errors import HydraException
from numpy.typing import NDArray
from omegaconf import DictConfig

from fmtorch.core import Correspondences, Estimate, Features, collate, failures, stages
from fmtorch.core.stages import Estimator, FeatureExtractor, GreyPyramid, ImageMatcher, Matcher, PairImages, Pruner
from fmtorch.data import ImagePair, ImageSource, read_image, to_grey
from fmtorch.geometry.significance import judged
from fmtorch.jobs.execution import one_thread
from fmtorch.presets.composition import PIPELINES, build_pruners, compose, expect_stages, open_files, plain
from fmtorch.presets.files import available, instantiate, unknown
from fmtorch.runs.feature_cache import CachedFeatures, cached
from fmtorch.two_view.arguments import expect_possible
from fmtorch.two_view.known_cameras import KnownCameras
from fmtorch.two_view.lenses import undistorted_matches
from fmtorch.two_view.pair_type import PairTypes, classify, compile_with

Key = TypeVar("Key")
Value = TypeVar("Value")


class Memo(Generic[Key, Value]):
    """Keeps the most recently used results; threads that ask for the same one share one computation."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._futures: OrderedDict[Key, Future[Value]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Key, compute: Callable[[], Value]) -> Value:
        """The value of `key`, computed if it is not there; an exception is kept and raised again."""
        with self._lock:
            mine = key not in self._futures
            future = self._futures.setdefault(key, Future())
            self._futures.move_to_end(key)
            while len(self._futures) > self._capacity:
                self._futures.popitem(last=False)
        if mine:
            try:
                future.set_result(compute())
            except BaseException as error:
                future.set_exception(error)
        return future.result()


class Clock:
    """The seconds between its calls."""

    def __init__(self, device: torch.device) -> None:
        self._device, self._last = device, time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, step: str, seconds: float | None = None) -> None:
        """The time since the last call was spent on `step`, which counts for `seconds` where they are given."""
        synchronise(self._device)
        now = time.perf_counter()
        self.seconds[step] = now - self._last if seconds is None else seconds
        self._last = now


def synchronise(device: torch.device) -> None:
    """Wait for what a GPU is still doing."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """What a pipeline made of one pair.
    correspondences, estimate: batches of one; None where the pair failed before that stage. features: how many each
    image has. seconds: per stage; a batched stage is shared out evenly, and features count in full for each pair that
    uses them, cached ones with the seconds they took when they were computed. reason: why the pair failed, empty where
    it did not. pair_type, not_examined: of this pair alone, or why there is none, where it was asked for
    (`fmtorch.pipeline.pipeline`). images: for pruners that look at them. keypoints: the correspondences as the matcher
    left them, where pruners that look at images, or undistortion, may have moved their points."""

    pair: ImagePair
    features: tuple[int, int] = (0, 0)
    correspondences: Correspondences | None = None
    estimate: Estimate | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    reason: str = ""
    pair_type: PairTypes | None = None
    not_examined: str = ""
    images: PairImages | None = None
    keypoints: Correspondences | None = None

    @property
    def solved(self) -> bool:
        return self.estimate is not None and bool(self.estimate.ok[0])


def collated(outcomes: Sequence[Outcome]) -> Correspondences:
    """The matches of the outcomes that have some, as one batch."""
    return collate([outcome.correspondences for outcome in outcomes if outcome.correspondences is not None])


STAGES = ("features", "matching", "pruning", "estimation")
Stage = Callable[[list[Outcome]], list[Outcome]]
MAX_TRACEBACKS = 3  # of different failures of a user's own code that are kept


class Pipeline:
    """Features, matcher, pruners in order, estimator. Safe to call from several threads.
    memory: how many images' features are kept for pairs to come (about 5 MB an image at 8,000 SIFT features), and their
    grey levels where a pruner looks at them. families: by family, pruners that its pairs get in place of those of the
    same names. model: what the estimator must give, "fundamental" or "homography" (`Estimate.model`); None: either.
    debug: raise what a stage raises, else the reason for its pair's failure. tracebacks: of a user's stages."""

    def __init__(
        self, features: FeatureExtractor, matcher: Matcher, pruners: Mapping[str, Pruner], estimator: Estimator, *,
        device: torch.device | str = "cpu", memory: int = 64,
        families: Mapping[str, Mapping[str, Pruner]] | None = None, model: str | None = "fundamental",
        debug: bool = False,
    ) -> None:  # fmt: skip
        if model is not None and (gives := stages.model_of(estimator)) != model:
            hint = ": estimator=homography" if model == "homography" else ""
            raise ValueError(f"the estimator gives {gives} matrices; a pipeline needs {model} matrices here{hint}")
        self.extractor, self.matcher, self.pruners, self.estimator = features, matcher, dict(pruners), estimator
        self.families = dict(families or {})
        self.device = torch.device(device)
        self.debug, self.tracebacks = debug, dict[str, str]()
        self._memo: Memo[Hashable, tuple[Features, float]] = Memo(memory)
        self._pyramids: Memo[Hashable, GreyPyramid] = Memo(memory)
        every = [self.pruners, *self.families.values()]
        self.looks_at_images = any(isinstance(pruner, stages.ImagePruner) for each in every for pruner in each.values())

    def features(self, image: ImageSource) -> tuple[Features, float]:
        """The features of an image and the seconds they took, kept for the next pair that shows the image."""
        return self._memo.get(image.pixels, lambda: self.extract(self._pixels(image)))

    def images(self, pair: ImagePair) -> PairImages:
        """The grey levels of a pair's images, read where they are not kept since the features were computed."""
        return self._pyramid(pair.image0), self._pyramid(pair.image1)

    def _pyramid(self, image: ImageSource) -> GreyPyramid:
        return self._pyramids.get(image.pixels, lambda: stages.grey_pyramid(to_grey(read_image(image))))

    def _pixels(self, image: ImageSource) -> NDArray[np.uint8]:
        """An image's pixels for its features, whose grey levels are kept where a pruner will look at them."""
        pixels = read_image(image)
        if self.looks_at_images:
            self._pyramids.get(image.pixels, lambda: stages.grey_pyramid(to_grey(pixels)))
        return pixels

    def extract(self, image: NDArray[np.uint8]) -> tuple[Features, float]:
        """The features of pixels on the pipeline's device, and the seconds that computing them takes or took."""
        if isinstance(self.extractor, CachedFeatures):
            features, seconds = self.extractor.timed(image)
            return features.to(self.device), seconds
        start = time.perf_counter()
        features = stages.output_of(self.extractor, stages.called("image", self.extractor, image), Features)
        features = features.to(self.device)
        synchronise(self.device)
        return features, time.perf_counter() - start

    def correspondences(self, pairs: Sequence[ImagePair]) -> list[Outcome]:
        """Take pairs through the stages before estimation; a pair that fails has a reason and harms no other."""
        return self._batched("pruning", self._prune, [self._match(pair) for pair in pairs])

    def estimate(self, outcomes: Sequence[Outcome], seed: int = 0) -> list[Outcome]:
        return self._batched("estimation", functools.partial(self._estimate, seed=seed), outcomes)

    def matched(self, image0: Any, image1: Any) -> Correspondences:
        """The matcher's matches of two images, given by their features; by their pixels for an `ImageMatcher`."""
        if isinstance(self.matcher, ImageMatcher):
            c = stages.called("image0, image1", self.matcher.match_images, image0, image1)
            c = stages.output_of(self.matcher, c, Correspondences).to(self.device)
        else:
            c = stages.called("features0, features1", self.matcher, image0, image1)
            c = stages.output_of(self.matcher, c, Correspondences, like=image0.lafs)
        name = stages.name_of(self.matcher)
        if not name.startswith("fmtorch."):
            try:
                expect_possible(c)
            except ValueError as error:
                raise ValueError(f"{name} returned matches that cannot be: {error}") from error
        return c

    def estimated(self, c: Correspondences, seed: int = 0) -> Estimate:
        """The estimate of a batch with its significance, and with its cameras where the matches ask for them."""
        used = KnownCameras(self.estimator) if c.asks_for_cameras else self.estimator
        estimate = stages.output_of(used, stages.called("c, seed=0", used, c, seed), Estimate, c)
        return judged(estimate.detach(), c)

    def run(self, pairs: Sequence[ImagePair], seed: int = 0) -> list[Outcome]:
        matched = [self._match(pair) for pair in pairs]
        compile_with([*self.pruners.values(), self.estimator])  # not before: other threads may be at it
        return self.estimate(self._batched("pruning", self._prune, matched), seed)

    def _batched(self, stage: str, function: Stage, outcomes: Sequence[Outcome]) -> list[Outcome]:
        """A batched stage over the pairs with matches; where it raises, pair by pair: only the culprit fails."""
        matched = [i for i, outcome in enumerate(outcomes) if outcome.correspondences is not None]
        start = time.perf_counter()
        with one_thread(self.device):
            try:
                results = function([outcomes[i] for i in matched]) if matched else []
            except Exception as error:  # whose fault it is shows pair by pair
                if self.debug:
                    raise
                results = [self._alone(stage, function, outcomes[i]) for i in matched]
                if all(result.correspondences is not None for result in results):
                    reason = f"{stage}: {failures.in_a_line(error)}"
                    said = f"of a batch of {len(matched)} pairs, though of each alone it does not: {reason}"
                    self.tracebacks.setdefault(said, failures.own_traceback(error))
        synchronise(self.device)
        share = (time.perf_counter() - start) / max(len(matched), 1)
        result = list(outcomes)
        for i, outcome in zip(matched, results, strict=True):
            result[i] = dataclasses.replace(outcome, seconds={**outcome.seconds, stage: share})
        return result

    def _match(self, pair: ImagePair) -> Outcome:
        if pair.problem is not None:
            return Outcome(pair, reason=pair.problem)
        stage, counts, seconds = "matches", (0, 0), dict[str, float]()
        try:
            if pair.matches is not None:
                c, counts = pair.matches()
            elif isinstance(self.matcher, ImageMatcher):
                stage = "images"
                images = read_image(pair.image0), read_image(pair.image1)
                stage, start = "matching", time.perf_counter()
                c = self.matched(*images)
                seconds["matching"] = time.perf_counter() - start
                counts = (int(c.count()), int(c.count()))
            else:
                stage = "features"
                (features0, seconds0), (features1, seconds1) = self.features(pair.image0), self.features(pair.image1)
                counts, seconds["features"] = (len(features0), len(features1)), seconds0 + seconds1
                if min(counts) == 0:
                    which = " and ".join(f"image {i}" for i in (0, 1) if counts[i] == 0)
                    return Outcome(pair, counts, seconds=seconds, reason=f"no keypoints in {which}")
                stage, start = "matching", time.perf_counter()
                c = self.matched(features0, features1)
                seconds["matching"] = time.perf_counter() - start
        except Exception as error:  # a pair that fails becomes a row with this reason
            return Outcome(pair, counts, seconds=seconds, reason=self._failure(stage, error))
        pyramids = self.images(pair) if self.looks_at_images and pair.matches is None else None
        given = (None if K is None else torch.from_numpy(K).to(self.device, torch.float64) for K in (pair.K0, pair.K1))
        K0, K1 = (None if K is None else K[None] for K in given)
        c = c.to(self.device).replace(key=torch.tensor([pair.key], device=self.device), K0=K0, K1=K1)
        return Outcome(pair, counts, c, None, seconds, images=pyramids)

    def pruners_of(self, family: str) -> dict[str, Pruner]:
        return {**self.pruners, **self.families.get(family, {})}

    def _prune(self, outcomes: list[Outcome]) -> list[Outcome]:
        result = list(outcomes)
        others = {outcome.pair.family for outcome in outcomes} & self.families.keys()
        for family in [None, *sorted(others)]:  # None: all that have no pruners of their own
            own = [i for i, o in enumerate(outcomes) if (o.pair.family if o.pair.family in others else None) == family]
            if own:
                family_outcomes = [outcomes[i] for i in own]
                c = collated(family_outcomes)
                keypoints = Correspondences(c.x0, c.x1, c.mask, ratio=c.ratio, score=c.score)

                def images(i: int, family_outcomes: list[Outcome] = family_outcomes) -> PairImages:
                    return family_outcomes[i].images or self.images(family_outcomes[i].pair)

                for pruner in self.pruners_of(family or "").values():
                    c = stages.pruned(pruner, c, images)
                    if self.looks_at_images:
                        keypoints = keypoints.derived(mask=c.mask).compact()
                    c = c.compact()
                for place, i in enumerate(own):
                    ends = keypoints[place] if self.looks_at_images else None
                    result[i] = dataclasses.replace(outcomes[i], correspondences=c[place], images=None, keypoints=ends)
        return result

    def _estimate(self, outcomes: list[Outcome], seed: int) -> list[Outcome]:
        c = collated(outcomes)
        given = [outcome.pair.given for outcome in outcomes]
        for name in given[0] or ():
            values = [None if each is None else each[name] for each in given]
            known = [value.to(c.mask.device) for value in values if value is not None]
            c = c.derived(**{name: torch.stack(known) if known else None})
        images = [(o.pair.image0, o.pair.image1) for o in outcomes]
        lenses = [(first.bending, second.bending) for first, second in images]
        bent = any(lens is not None for both in lenses for lens in both)
        seen = undistorted_matches(c, lenses).derived(lens=None, shared_lens=None) if bent else c
        estimate, result = self.estimated(seen if c.lens is None else c, seed), []
        for i, outcome in enumerate(outcomes):
            keypoints = outcome.keypoints
            if seen is not c:
                keypoints = c[i] if keypoints is None else keypoints
                keypoints = keypoints.derived(mask=seen.mask[i : i + 1, : keypoints.mask.shape[1]])
            own = dataclasses.replace(outcome, estimate=estimate[i], reason=estimate.reason[i], keypoints=keypoints)
            result.append(dataclasses.replace(own, correspondences=seen[i]))
        return result

    def _alone(self, stage: str, function: Stage, outcome: Outcome) -> Outcome:
        """A stage on a single pair; what it raises becomes the reason for that pair's failure."""
        try:
            return function([outcome])[0]
        except Exception as error:
            return dataclasses.replace(outcome, correspondences=None, images=None, reason=self._failure(stage, error))

    def _failure(self, stage: str, error: Exception) -> str:
        """What a stage raised, as a reason, its traceback kept if it is of a user's own code; raised for `debug`."""
        if self.debug:
            raise error
        reason = f"{stage}: {failures.in_a_line(error)}"
        if len(self.tracebacks) < MAX_TRACEBACKS and (text := failures.own_traceback(error)):
            self.tracebacks.setdefault(reason, text)
        return reason


def examined(pipeline: Pipeline, outcomes: Sequence[Outcome], seed: int = 0) -> list[Outcome]:
    """The outcomes of a run with their pair types; a pair that cannot be examined has none and harms no other.
    Where the estimator was given nothing of the cameras, K does not count here. Of homographies nothing is asked."""
    if stages.model_of(pipeline.estimator) != "fundamental":
        return list(outcomes)
    matched = {i: o for i, o in enumerate(outcomes) if o.correspondences is not None and o.estimate is not None}
    with one_thread(pipeline.device):
        own = dict(zip(matched, _examined([*matched.values()], seed), strict=True)) if matched else {}
    return [own.get(i, outcome) for i, outcome in enumerate(outcomes)]


def _examined(outcomes: Sequence[Outcome], seed: int) -> list[Outcome]:
    try:
        c = collated(outcomes)
        estimate = collate([o.estimate for o in outcomes if o.estimate is not None])
        estimate = estimate.derived(lens=None) if c.lens is None else estimate  # of matches that are undistorted
        pair_type = classify(c if outcomes[0].pair.given else c.derived(K0=None, K1=None), estimate, seed=seed)
        return [dataclasses.replace(outcome, pair_type=pair_type.of_pair(i)) for i, outcome in enumerate(outcomes)]
    except Exception as error:  # whose fault it is shows pair by pair
        if len(outcomes) > 1:
            return [each for outcome in outcomes for each in _examined([outcome], seed)]
        reason = f"not examined: {type(error).__name__}: {error}".splitlines()[0]
        return [dataclasses.replace(outcomes[0], not_examined=reason)]


def build_pipeline(
    config: DictConfig, device: torch.device | str = "cpu", model: str | None = "fundamental"
) -> Pipeline:
    """The `Pipeline` that features (with cache), matcher, pruner and estimator of a composed config describe.
    model: what the estimator must give, "fundamental" or "homography"; None: either."""
    expect_stages(config)
    extractor = cached(instantiate(plain(config.features), "features"), config.cache, config.cache_limit)
    pruners, for_families = build_pruners(config)
    open_files([extractor, pruners, for_families], torch.device(device))  # a damaged one is no failure of each pair
    return Pipeline(
        extractor, instantiate(plain(config.matcher), "matcher"), pruners,
        instantiate(plain(config.estimator), "estimator"), device=device, families=for_families, model=model,
        debug=bool(config.get("debug")),
    )  # fmt: skip


def load_pipeline(
    name: str, device: torch.device | str = "cpu", overrides: Sequence[str] = (), config_dir: Path | str | None = None
) -> Pipeline:
    """The `Pipeline` of ``conf/pipeline/<name>.yaml``, changed by `overrides` as on the command line.

    E.g. ``load_pipeline("sift_gms", overrides=["estimator=lmeds", "pruner.gms.with_scale=true"])``. Unlike the
    commands it keeps no features on disk unless asked to (``overrides=["cache=null"]``, or a folder).

    Args:
        name: a preset of conf/pipeline, or of `config_dir`.
        device: where features are described and everything behind them is computed.
        overrides: as words of a command.
        config_dir: a folder with presets of your own, as the commands take it by `--config-dir`.

    Raises:
        ValueError: for an unknown pipeline, an override that does not apply, and a `config_dir` that is no folder.
    """
    if config_dir is not None and not Path(config_dir).is_dir():
        raise ValueError(f"config_dir={config_dir} is no folder")
    if name not in available("pipeline", config_dir):
        raise ValueError(unknown("pipeline", name, config_dir))
    words = (f"pipeline={name}", "cache=off", *overrides)
    try:
        config = compose(PIPELINES, words, None if config_dir is None else Path(config_dir))
    except HydraException as error:
        raise ValueError(f"pipeline={name} with {', '.join(overrides)}: {error}") from error
    return build_pipeline(config, device)
