"""The protocols of the four stages: what anything must look like to take its place in a pipeline.

Beside them the grey images that pruners look at, and the extractor of matchers that take the images themselves."""

import contextlib
import dataclasses
import inspect
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar, cast, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.types import Correspondences, Estimate, Features

LEVELS = 5  # at most
MIN_SIDE = 32  # px, of a level that has a coarser one
SMOOTHING = 0.5  # px, of every level: contrast between pixels is then lowered nearly as much as on them


class GreyPyramid(NamedTuple):
    """Levels of an image, each of half the samples of the one before: point x of the image is at x / 2^l of level l.
    pixels: (sum,) uint8, the grey levels of all, row by row. levels: (l, 3) int64, of each its height, its width and
    where it begins in `pixels`. Four thirds of a byte for each pixel of the image."""

    pixels: NDArray[np.uint8]
    levels: NDArray[np.int64]


def grey_pyramid(image: NDArray[np.uint8]) -> GreyPyramid:
    """The pyramid of a grey image (H, W): Burt and Adelson, The Laplacian Pyramid as a Compact Image Code, 1983.
    Every other sample is taken of an image smoothed by a binomial filter; what is kept of each is smoothed slightly."""
    import cv2  # not before an image is there: protocols of matches alone name this file

    images: list[Any] = [image]
    while len(images) < LEVELS and min(images[-1].shape) >= MIN_SIDE:
        images.append(cv2.pyrDown(images[-1]))
    begins = np.cumsum([0, *(level.size for level in images[:-1])])
    levels = np.array([(*level.shape, begin) for level, begin in zip(images, begins, strict=True)], np.int64)
    return GreyPyramid(np.concatenate([cv2.GaussianBlur(level, (3, 3), SMOOTHING).ravel() for level in images]), levels)


PairImages: TypeAlias = tuple[GreyPyramid, GreyPyramid]
Output = TypeVar("Output", Features, Correspondences, Estimate)


@runtime_checkable
class FeatureExtractor(Protocol):
    """An image (H, W) or (H, W, 3), uint8, RGB -> its local features."""

    def __call__(self, image: NDArray[np.uint8]) -> Features: ...


@runtime_checkable
class TwoStepExtractor(FeatureExtractor, Protocol):
    """An extractor whose two steps a cache keeps apart: extractors with the same detection share its results.
    Calling it equals ``describe(image, lafs)`` after ``lafs, scores = detect(image)``: a descriptor for each frame.
    detection: what defines the frames and scores: parts, options, files (`fingerprint.configuration`). detect: local
    affine frames and their scores. describe: the descriptors of the frames, which may be on the CPU."""

    @property
    def detection(self) -> object: ...

    def detect(self, image: NDArray[np.uint8]) -> tuple[Float[Tensor, "n 2 3"], Float[Tensor, " n"]]: ...

    def describe(self, image: NDArray[np.uint8], lafs: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n d"]: ...


@runtime_checkable
class Matcher(Protocol):
    """The features of two images -> putative correspondences of that one pair."""

    def __call__(self, features0: Features, features1: Features) -> Correspondences: ...


@runtime_checkable
class ImageMatcher(Matcher, Protocol):
    """A matcher that takes the images themselves, and that refuses to be called with their features."""

    def match_images(self, image0: NDArray[np.uint8], image1: NDArray[np.uint8]) -> Correspondences:
        """Images (H, W) or RGB (H, W, 3), uint8 -> putative correspondences of that one pair, with image sizes."""


@runtime_checkable
class Pruner(Protocol):
    """Correspondences -> the same, fewer of them surviving, or with a prior."""

    def __call__(self, c: Correspondences) -> Correspondences: ...


@runtime_checkable
class ImagePruner(Pruner, Protocol):
    """A pruner that looks at the images, and that refuses to be called without them."""

    def with_images(self, c: Correspondences, images: Callable[[int], PairImages]) -> Correspondences:
        """images: of pair i of the batch, read when they are asked for."""


def pruned(pruner: Pruner, c: Correspondences, images: Callable[[int], PairImages]) -> Correspondences:
    """What a pruner makes of correspondences, with the images where it looks at them."""
    if isinstance(pruner, ImagePruner):
        return output_of(pruner, called("c, images", pruner.with_images, c, images), Correspondences, c)
    return output_of(pruner, called("c", pruner, c), Correspondences, c)


@runtime_checkable
class Estimator(Protocol):
    """Correspondences -> fundamental matrices."""

    def __call__(self, c: Correspondences, seed: int = 0) -> Estimate: ...


def model_of(estimator: Estimator) -> str:
    """What an estimator's matrices are, `Estimate.model`: fundamental, unless it says otherwise."""
    return str(getattr(estimator, "model", "fundamental"))


@dataclasses.dataclass(frozen=True)
class NoFeatures:
    """Finds nothing: an extractor for matchers that take images. keep: nothing of it is worth a place in a cache."""

    keep = False

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        size = torch.tensor(image.shape[:2], dtype=torch.int64)
        return Features(torch.zeros(0, 2, 3), torch.zeros(0), torch.zeros(0, 0), size)


class WrongPart(TypeError, ValueError):
    """A user's part takes or returned something that its stage does not allow: its author can put it right."""


def called(wanted: str, part: Any, *given: Any) -> Any:
    """What a part returns, see `calling`."""
    with calling(wanted, part, *given):
        return part(*given)


@contextlib.contextmanager
def calling(wanted: str, part: Any, *given: Any) -> Iterator[None]:
    """Around a call of a part, which may be anybody's code. wanted: the parameters that a part of this kind takes.
    Raises WrongPart naming the place of one that takes others, that cannot be called, or that changes what it is given,
    RuntimeError for one that ends the program."""
    if not callable(part):
        raise WrongPart(f"{name_of(part)} cannot be called; it must have __call__({wanted})")
    before = _state(given)
    try:
        yield
        if _state(given) != before:
            raise WrongPart(f"{name_of(part)} changes what it is given, which others use: it must change a copy")
    except SystemExit as error:
        raise RuntimeError(f"{name_of(part)} ended the program: sys.exit({error.code!r})") from error
    except TypeError as error:
        function: Any = part if hasattr(part, "__code__") else getattr(part, "forward", part.__call__)
        if name_of(part).startswith("fmtorch.") or not hasattr(function, "__code__"):
            raise
        try:
            inspect.signature(function).bind(*given)
        except TypeError:
            where = f"{Path(function.__code__.co_filename).name}:{function.__code__.co_firstlineno}"
            takes = f"takes {inspect.signature(function)}; it is called with ({wanted})"
            raise WrongPart(f"{name_of(part)} ({where}) {takes}") from error
        raise


def _state(given: Sequence[Any]) -> list[int]:
    """What tells whether matches, or the pixels of an image, were changed in place."""
    fields = [t for c in given if isinstance(c, Correspondences) for t in (c.x0, c.x1, c.mask) if not t.is_inference()]
    images = [np.ascontiguousarray(image).data for image in given if isinstance(image, np.ndarray)]
    return [*(t._version for t in fields), *map(zlib.crc32, images)]


def name_of(part: object) -> str:
    """The module and the name of a part's class, or of a function."""
    named = part if isinstance(part, type) or hasattr(part, "__qualname__") else type(part)
    return f"{named.__module__}.{named.__qualname__}"


def output_of(
    part: object, value: object, kind: type[Output], given: Correspondences | None = None, like: Tensor | None = None
) -> Output:
    """What a stage returned, which may be anybody's code: a value of this kind.
    given: the matches that it was given, whose pairs and device are those of the result. like: a tensor on the device
    that the result must be on, where no matches were given. Raises TypeError for something else, ValueError for other
    pairs, another number of them or of matches, another device, and half precision, naming the part."""
    name = name_of(part)
    if not isinstance(value, kind):
        what = "None" if value is None else f"a {type(value).__name__}"
        raise WrongPart(f"{name} returned {what}; it must return {kind.__name__}")
    main = getattr(value, "lafs" if kind is Features else "x0" if kind is Correspondences else "matrix")
    if main.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name} returned {kind.__name__} of {main.dtype}; they must be of float32 or float64")
    if isinstance(value, Features):
        if value.lafs.dim() != 3:
            raise ValueError(f"{name} returned features of a batch of images; they must be of one, lafs (N, 2, 3)")
        return value
    like = like if given is None else given.x0
    if like is not None and main.device != like.device:
        raise ValueError(f"{name} returned {kind.__name__} on {main.device}; they must be on {like.device}")
    pairs = 1 if given is None else len(given)
    if len(value) != pairs:
        raise ValueError(f"{name} returned {kind.__name__} of {len(value)} pairs; they must be of {pairs}")
    if given is None:
        return value
    what, slots = ("inliers", value.inliers) if isinstance(value, Estimate) else ("matches", cast(Any, value).mask)
    if slots.shape != given.mask.shape:
        shape, wanted = tuple(slots.shape), tuple(given.mask.shape)
        raise ValueError(f"{name} returned {what} of shape {shape}; it must be that of the mask, {wanted}")
    if isinstance(value, Correspondences) and not torch.equal(value.keys, given.keys):
        raise ValueError(f"{name} returned matches without their pairs' keys; use c.keep(mask) or c.replace(prior=...)")
    return sound(value, name) if isinstance(value, Estimate) else value


def sound(estimate: Estimate, name: str) -> Estimate:
    """The estimate of a part: pairs without a matrix are not ok, and exactly those that are not ok have a reason."""
    valid = torch.isfinite(estimate.matrix).flatten(1).all(1) & (estimate.matrix != 0).flatten(1).any(1)
    ok, claimed = (estimate.ok & valid).tolist(), estimate.ok.tolist()
    if ok == claimed and all(bool(reason) != fine for reason, fine in zip(estimate.reason, ok, strict=True)):
        return estimate
    wrong = "estimation: F is zero or not finite, though the estimator calls it ok"
    reasons = [
        "" if fine else wrong if was else reason or f"{name} gives no reason"
        for fine, was, reason in zip(ok, claimed, estimate.reason, strict=True)
    ]
    F, inliers = torch.where(valid[:, None, None], estimate.matrix, 0), estimate.inliers & valid[:, None]
    fields = {"matrix": F, "inliers": inliers, "ok": estimate.ok & valid, "reason": tuple(reasons)}
    return estimate.replace(**fields, significance=None)
