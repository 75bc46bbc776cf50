"""The four stages in a row: features, matching, pruning, estimation; batching, timing, failures as data."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.data.images import read_image
from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.stages import Estimator, FeatureExtractor, Matcher, Pruner
from fmtorch.types import Correspondences, Estimate, Features, collate

STAGES = ("features", "matching", "pruning", "estimation")


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """What a pipeline made of one pair.

    correspondences, estimate: batches of one, on the CPU; None where the pair failed before that stage.
    features: how many each image has. seconds: per stage; a batched stage is shared out evenly, and features count in
    full for each pair that uses them. reason: why the pair failed, empty where it did not.
    """

    pair: ImagePair
    features: tuple[int, int]
    correspondences: Correspondences | None
    estimate: Estimate | None
    seconds: dict[str, float]
    reason: str


@dataclasses.dataclass(frozen=True, eq=False)
class _Matched:
    """A pair on its way through the stages."""

    pair: ImagePair
    features: tuple[int, int] = (0, 0)
    correspondences: Correspondences | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    reason: str = ""


class Pipeline:
    """Features, matcher, pruners in order, estimator. Safe to call from several threads.

    memory: how many images' features are kept for pairs to come (about 5 MB an image at 8,000 SIFT features).
    """

    def __init__(
        self,
        features: FeatureExtractor,
        matcher: Matcher,
        pruners: Mapping[str, Pruner],
        estimator: Estimator,
        *,
        device: torch.device | str = "cpu",
        memory: int = 64,
    ) -> None:
        self.extractor, self.matcher, self.pruners, self.estimator = features, matcher, dict(pruners), estimator
        self.device = torch.device(device)
        self._memo: _Memo[str, tuple[Features, float]] = _Memo(memory)

    def features(self, image: ImageSource) -> tuple[Features, float]:
        """The features of an image and the seconds they took, kept for the next pair that shows the image."""
        return self._memo.get(f"{image.path}", lambda: self._extract(image))

    def run(self, pairs: Sequence[ImagePair], seed: int = 0) -> list[Outcome]:
        """Take a batch of pairs through all stages; a pair that fails has a reason and harms no other."""
        matched = [self._match(pair) for pair in pairs]
        alive = [m for m in matched if m.correspondences is not None]
        outcomes: dict[int, Outcome] = {}
        if alive:
            for m, outcome in zip(alive, self._prune_and_estimate(alive, seed), strict=True):
                outcomes[id(m)] = outcome
        return [outcomes[id(m)] if id(m) in outcomes else _failed(m) for m in matched]

    def _extract(self, image: ImageSource) -> tuple[Features, float]:
        start = time.perf_counter()
        features = self.extractor(read_image(image)).to(self.device)
        return features, time.perf_counter() - start

    def _match(self, pair: ImagePair) -> _Matched:
        if pair.problem is not None:
            return _Matched(pair, reason=pair.problem)
        try:
            (features0, seconds0), (features1, seconds1) = self.features(pair.image0), self.features(pair.image1)
        except Exception as error:  # a pair that fails becomes a row with this reason
            return _Matched(pair, reason=_describe("features", error))
        seconds = {"features": seconds0 + seconds1}
        counts = (len(features0), len(features1))
        if min(counts) == 0:
            which = " and ".join(f"image {i}" for i in (0, 1) if counts[i] == 0)
            return _Matched(pair, counts, seconds=seconds, reason=f"no keypoints in {which}")
        start = time.perf_counter()
        try:
            c = self.matcher(features0, features1)
        except Exception as error:
            return _Matched(pair, counts, seconds=seconds, reason=_describe("matching", error))
        seconds["matching"] = time.perf_counter() - start
        K0, K1 = (_calibration(K, self.device) for K in (pair.K0, pair.K1))
        c = c.replace(key=torch.tensor([pair.key], device=self.device), K0=K0, K1=K1)
        return _Matched(pair, counts, c, seconds)

    def _prune_and_estimate(self, matched: list[_Matched], seed: int) -> list[Outcome]:
        """The batched stages; where they raise, once more pair by pair, so that only the culprit fails."""
        stage, start = "pruning", time.perf_counter()
        try:
            c = collate([m.correspondences for m in matched if m.correspondences is not None])
            for pruner in self.pruners.values():
                c = pruner(c).compact()
            pruned, stage = time.perf_counter(), "estimation"
            estimate = self.estimator(c, seed).detach()
            _synchronise(self.device)
            done = time.perf_counter()
        except Exception as error:
            if len(matched) > 1:
                return [outcome for m in matched for outcome in self._prune_and_estimate([m], seed)]
            return [_failed(dataclasses.replace(matched[0], reason=_describe(stage, error)))]
        share = {"pruning": (pruned - start) / len(matched), "estimation": (done - pruned) / len(matched)}
        c, estimate = c.detach().to("cpu"), estimate.to("cpu")
        return [
            Outcome(m.pair, m.features, c[i], estimate[i], {**m.seconds, **share}, estimate.reason[i])
            for i, m in enumerate(matched)
        ]


def _failed(m: _Matched) -> Outcome:
    return Outcome(m.pair, m.features, None, None, m.seconds, m.reason)


def _describe(stage: str, error: Exception) -> str:
    return f"{stage}: {type(error).__name__}: {error}".splitlines()[0]


def _calibration(K: NDArray[np.float64] | None, device: torch.device) -> torch.Tensor | None:
    return None if K is None else torch.from_numpy(K).to(torch.float64).to(device)[None]


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


Key = TypeVar("Key")
Value = TypeVar("Value")


class _Memo(Generic[Key, Value]):
    """Keeps the most recently used results; threads that ask for the same one share one computation."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._futures: OrderedDict[Key, Future[Value]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Key, compute: Callable[[], Value]) -> Value:
        """The value of `key`, computed if it is not there; an exception is kept and raised again."""
        with self._lock:
            future = self._futures.get(key)
            mine = future is None
            if future is None:
                future = self._futures[key] = Future()
            self._futures.move_to_end(key)
            while len(self._futures) > self._capacity:
                self._futures.popitem(last=False)
        if mine:
            try:
                future.set_result(compute())
            except BaseException as error:
                future.set_exception(error)
        return future.result()
