"""The feature cache: what an extractor finds in an image is kept under the image's and the extractor's digests."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.resources import cache_dir
from fmtorch.core.stages import FeatureExtractor, TwoStepExtractor
from fmtorch.core.types import Features
from fmtorch.storage.cache import ArrayCache
from fmtorch.storage.configuration import configuration, environment
from fmtorch.storage.runs import identity_digest

OFF = ("off", "none", "")


class CachedFeatures:
    """An extractor that keeps what another one finds, bit-equal, and computes only what it does not have.

    A `TwoStepExtractor` is kept in two files, frames under the digest of its `detection` alone; any other in one.
    Results are on the CPU. `timed` gives the seconds that the computation took when it was done, here or in another
    run. found, computed: images so far that needed no computation, and that needed some. For any number of threads.

    Raises TypeError where the extractor does not say what defines it, OSError where a file of it cannot be read (see
    `configuration`).
    """

    def __init__(self, extractor: FeatureExtractor, cache: ArrayCache) -> None:
        self.extractor, self.cache = extractor, cache
        name = type(extractor).__name__
        self._extraction = self._section(name, extractor)
        self._detection = ""
        if isinstance(extractor, TwoStepExtractor):
            self._detection = self._section("detection", extractor.detection)
        self._lock = threading.Lock()
        self.found = self.computed = 0

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """The features of an image, from the cache where they are there."""
        return self.timed(image)[0]

    def timed(self, image: NDArray[np.uint8]) -> tuple[Features, float]:
        """The features, and the seconds that computing them took when it was done."""
        digest = image_digest(image)
        extractor = self.extractor
        if isinstance(extractor, TwoStepExtractor):
            frames = self._kept(self._detection, digest, lambda: _named(("lafs", "scores"), extractor.detect(image)))
            lafs = frames.tensors["lafs"]
            described = self._kept(self._extraction, digest, lambda: {"descriptors": extractor.describe(image, lafs)})
            steps = [frames, described]
            size = {"image_size": torch.tensor(image.shape[:2], dtype=torch.int64)}
        else:
            steps, size = [self._kept(self._extraction, digest, lambda: _fields(extractor(image)))], {}
        with self._lock:
            computed = any(step.computed for step in steps)
            self.computed, self.found = self.computed + computed, self.found + (not computed)
        tensors = {name: value for step in steps for name, value in step.tensors.items()}
        return Features(**tensors, **size), sum(step.seconds for step in steps)

    def report(self) -> str:
        """One line: what was computed and found so far, and the size of the cache."""
        sizes = [status.st_size for _, status in self.cache.files()]
        return (
            f"features of {self.computed} images computed, of {self.found} taken from the cache; "
            f"{self.cache.folder}: {len(sizes)} files, {sum(sizes) / 1e6:.1f} MB"
        )

    def _section(self, name: str, part: object) -> str:
        identity = {"configuration": configuration(part), "environment": environment()}
        section = f"{name}-{identity_digest(identity)[:16]}"
        self.cache.describe(section, identity)
        return section

    def _kept(self, section: str, digest: str, compute: Callable[[], Mapping[str, Tensor]]) -> _Step:
        """One step's result, from the cache or computed and kept."""
        arrays = self.cache.read(section, digest)
        if arrays is not None:
            seconds = float(arrays.pop("seconds"))
            return _Step({name: _unpacked(array) for name, array in arrays.items()}, seconds, computed=False)
        start = time.perf_counter()
        tensors = {name: value.detach().cpu() for name, value in compute().items()}
        seconds = time.perf_counter() - start
        arrays = {name: _packed(value) for name, value in tensors.items()}
        self.cache.write(section, digest, {**arrays, "seconds": np.array(seconds)})
        return _Step(tensors, seconds, computed=True)


def cached(
    extractor: FeatureExtractor, cache: str | Path | bool | None, limit: int | float | None = None
) -> FeatureExtractor:
    """The extractor with a cache in the folder `cache`; None: the user's cache folder; "off" or False: as it is.

    limit: GB, see `ArrayCache`. An extractor that does not say what defines it, or whose files cannot be read, stays as
    it is, with a warning.
    """
    if cache is False or str(cache) in OFF or not getattr(extractor, "keep", True):
        return extractor
    folder = cache_dir() / "features" if cache is None else Path(str(cache)).expanduser()
    try:
        return CachedFeatures(extractor, ArrayCache(folder, None if limit is None else int(limit * 1e9)))
    except (TypeError, OSError) as error:  # of a learned file that is not there the extractor speaks better
        warnings.warn(f"features are not cached: {error}", stacklevel=2)
        return extractor


def image_digest(image: NDArray[np.uint8]) -> str:
    """The hex digest (SHA-256) of an image's shape and pixels."""
    digest = hashlib.sha256(repr((image.dtype.str, image.shape)).encode())
    digest.update(np.ascontiguousarray(image).data)
    return digest.hexdigest()


@dataclasses.dataclass(frozen=True, eq=False)
class _Step:
    tensors: dict[str, Tensor]
    seconds: float
    computed: bool


def _named(names: tuple[str, ...], tensors: tuple[Tensor, ...]) -> dict[str, Tensor]:
    return dict(zip(names, tensors, strict=True))


def _fields(features: Features) -> dict[str, Tensor]:
    return {field.name: getattr(features, field.name) for field in dataclasses.fields(features)}


def _packed(value: Tensor) -> NDArray[Any]:
    """The array of a tensor; bytes where every element is a whole number from 0 to 255, as SIFT's are."""
    array = value.numpy()
    if array.dtype == np.float32:
        with np.errstate(invalid="ignore"):
            small = array.astype(np.uint8)
        if np.array_equal(small.astype(np.float32).view(np.uint32), array.view(np.uint32)):  # to the sign of zero
            return small
    return array


def _unpacked(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(array.astype(np.float32) if array.dtype == np.uint8 else array)
