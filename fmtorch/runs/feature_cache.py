"""Arrays kept on disk by name, one NumPy file each, in a folder of bounded size that several processes may share."""

import contextlib
import functools
import hashlib
import json
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core import Features, files
from fmtorch.core.stages import FeatureExtractor, TwoStepExtractor, called, output_of
from fmtorch.runs.fingerprint import configuration, environment
from fmtorch.runs.run_folder import identity_digest

Arrays = dict[str, NDArray[Any]]
DIGEST = "digest"  # the array that holds the digest of the others
SLACK = 0.05  # share of the bound that is freed at once, so that the folder is not listed for every file
ABANDONED = 3600.0  # seconds after which a temporary file is a dead writer's


class ArrayCache:
    """Files ``<folder>/<section>/<name>.npz``, each whole or absent. Safe with several threads and processes.
    limit: bytes; when more are kept, the least recently used files go (each process may exceed it by `SLACK`). None: no
    bound. A file that is damaged, or holds other arrays than were written under its name, counts as absent, with a
    warning; what cannot be written is not kept, with a warning. Raises ValueError where the folder is a file or the
    limit is not positive."""

    def __init__(self, folder: Path, limit: int | None = None) -> None:
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"cache={folder} is a file; it must name a folder, or be off")
        if limit is not None and limit <= 0:
            raise ValueError(f"the cache's limit is {limit} bytes; it must be positive, or null for none")
        self.folder, self.limit = folder, limit
        self._lock = threading.Lock()
        self._unseen: float = np.inf  # bytes written since the folder was last listed

    def describe(self, section: str, about: Mapping[str, Any]) -> None:
        file = self.folder / section / "about.json"
        if not file.exists():
            with self._excused(file):
                file.parent.mkdir(parents=True, exist_ok=True)
                files.write_whole(file, json.dumps(about, indent=2) + "\n")

    def read(self, section: str, name: str) -> Arrays | None:
        """The arrays of that name, or None. Executes nothing that is in the file (no pickle), checks its checksums."""
        path = self._path(section, name)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
            if arrays.pop(DIGEST).tobytes() != self._digest(section, name, arrays):
                raise ValueError("it is not what was written there")
            os.utime(path)  # used now
        except FileNotFoundError:
            return None
        except Exception as error:  # a damaged file may make the reader raise nearly anything
            warnings.warn(f"{path} is damaged ({error}); it is computed anew", stacklevel=2)
            return None
        return arrays

    def write(self, section: str, name: str, arrays: Arrays) -> None:
        path = self._path(section, name)
        digest = np.frombuffer(self._digest(section, name, arrays), np.uint8)
        with self._excused(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with files.replacing(path) as temporary, temporary.open("wb") as file:
                np.savez(file, **arrays, **{DIGEST: digest})  # type: ignore[arg-type]
            with self._lock:
                self._unseen += sum(array.nbytes for array in arrays.values())
                if self._unseen >= SLACK * (self.limit or np.inf):
                    self.trim()
                    self._unseen = 0

    def files(self) -> Iterator[tuple[Path, os.stat_result]]:
        yield from _listed(self.folder.glob("*/*.npz"))

    def trim(self) -> None:
        """Remove the least recently used files beyond the limit, and what dead writers left."""
        for path, status in _listed(self.folder.glob("*/*.tmp")):
            if time.time() - status.st_mtime > ABANDONED:
                path.unlink(missing_ok=True)
        if self.limit is None:
            return
        kept = sorted(self.files(), key=lambda entry: entry[1].st_mtime_ns)
        excess = sum(status.st_size for _, status in kept) - self.limit
        if excess > 0:
            excess += int(SLACK * self.limit)
        for path, status in kept:
            if excess <= 0:
                break
            path.unlink(missing_ok=True)
            excess -= status.st_size

    @staticmethod
    def _digest(section: str, name: str, arrays: Arrays) -> bytes:
        digest = hashlib.blake2b(f"{section}/{name}".encode(), digest_size=16)
        for key, array in sorted(arrays.items()):
            digest.update(repr((key, array.dtype.str, array.shape)).encode())
            digest.update(np.ascontiguousarray(array).data)
        return digest.digest()

    def _path(self, section: str, name: str) -> Path:
        return self.folder / section / f"{name}.npz"

    @contextlib.contextmanager
    def _excused(self, path: Path) -> Iterator[None]:
        """A full disk or a folder that may not be written costs the cache, not the run."""
        try:
            yield
        except OSError as error:
            warnings.warn(f"nothing is kept in {path.parent}: {error.strerror or error}", stacklevel=3)


def _listed(paths: Iterator[Path]) -> Iterator[tuple[Path, os.stat_result]]:
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            yield path, path.stat()


OFF = ("off", "none", "")


class CachedFeatures:
    """An extractor that keeps what another one finds, bit-equal, and computes only what it does not have.
    A `TwoStepExtractor` is kept in two files, frames under the digest of its `detection` alone; any other in one.
    Results are on the CPU. `timed` gives the seconds that the computation took when it was done, here or in another
    run. found, computed: images so far. For any number of threads. Raises as `configuration` of the extractor."""

    def __init__(self, extractor: FeatureExtractor, cache: ArrayCache) -> None:
        self.extractor, self.cache = extractor, cache
        self._extraction = self._section(type(extractor).__name__, extractor)
        self._detection = ""
        if isinstance(extractor, TwoStepExtractor):
            self._detection = self._section("detection", extractor.detection)
        self._lock = threading.Lock()
        self.found = self.computed = 0

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        return self.timed(image)[0]

    def timed(self, image: NDArray[np.uint8]) -> tuple[Features, float]:
        """The features, and the seconds that computing them took when it was done."""
        digest = image_digest(image)
        extractor = self.extractor
        if isinstance(extractor, TwoStepExtractor):
            names, detect = ("lafs", "scores"), functools.partial(called, "image", extractor.detect, image)
            frames = self._kept(self._detection, digest, lambda: dict(zip(names, detect(), strict=True)))
            describe = functools.partial(called, "image, lafs", extractor.describe, image, frames.tensors["lafs"])
            described = self._kept(self._extraction, digest, lambda: {"descriptors": describe()})
            steps = [frames, described]
            size = {"image_size": torch.tensor(image.shape[:2], dtype=torch.int64)}
        else:
            extract = functools.partial(called, "image", extractor, image)
            whole = self._kept(self._extraction, digest, lambda: vars(output_of(extractor, extract(), Features)))
            steps, size = [whole], {}
        with self._lock:
            computed = any(step.computed for step in steps)
            self.computed, self.found = self.computed + computed, self.found + (not computed)
        tensors = {name: value for step in steps for name, value in step.tensors.items()}
        return Features(**tensors, **size), sum(step.seconds for step in steps)

    def report(self) -> str:
        """One line: what was computed and found so far, and the size of the cache."""
        sizes = [status.st_size for _, status in self.cache.files()]
        kept = f"{self.cache.folder}: {files.counted(len(sizes), 'file')}, {sum(sizes) / 1e6:.1f} MB"
        if not self.computed + self.found:  # nothing was to be done, or workers elsewhere did it
            return f"features are kept in {kept}"
        taken = f", of {self.found} taken from the cache" if self.found else ""
        return f"features of {files.counted(self.computed, 'image')} computed{taken}; {kept}"

    def _section(self, name: str, part: object) -> str:
        identity = {"configuration": configuration(part), "environment": environment()}
        section = f"{name}-{identity_digest(identity)[:16]}"
        self.cache.describe(section, identity)
        return section

    def _kept(self, section: str, digest: str, compute: Callable[[], Mapping[str, torch.Tensor]]) -> "_Step":
        arrays = self.cache.read(section, digest)
        if arrays is not None:
            seconds = float(arrays.pop("seconds"))
            wide = {key: each.astype(np.float32) if each.dtype == np.uint8 else each for key, each in arrays.items()}
            return _Step({key: torch.from_numpy(each) for key, each in wide.items()}, seconds, computed=False)
        start = time.perf_counter()
        tensors = {name: value.detach().cpu() for name, value in compute().items()}
        seconds = time.perf_counter() - start
        arrays = {name: _packed(value) for name, value in tensors.items()}
        self.cache.write(section, digest, {**arrays, "seconds": np.array(seconds)})
        return _Step(tensors, seconds, computed=True)


def cached(
    extractor: FeatureExtractor, cache: str | Path | bool | None, limit: int | float | None = None
) -> FeatureExtractor:
    """The extractor with a cache in the folder `cache`; None: the user's cache folder; "off" or False: as it is. limit:
    GB, see `ArrayCache`. An extractor without a `configuration` stays as it is, with a warning."""
    if cache is False or str(cache) in OFF or not getattr(extractor, "keep", True):
        return extractor
    folder = files.cache_dir() / "features" if cache is None else Path(str(cache)).expanduser()
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


class _Step(NamedTuple):
    tensors: dict[str, torch.Tensor]
    seconds: float
    computed: bool


def _packed(value: torch.Tensor) -> NDArray[Any]:
    """The array of a tensor; bytes where every element is a whole number from 0 to 255, as SIFT's are."""
    array = value.numpy()
    if array.dtype == np.float32:
        with np.errstate(invalid="ignore"):
            small = array.astype(np.uint8)
        if np.array_equal(small.astype(np.float32).view(np.uint32), array.view(np.uint32)):  # to the sign of zero
            return small
    return array
