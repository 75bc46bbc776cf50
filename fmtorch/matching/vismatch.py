"""Any matcher of the package vismatch (extra `vismatch`): two images in, matched points out, without features of ours.

The package (github.com/gmberton/vismatch, formerly image-matching-models) has one call for all of its matchers:
``get_matcher(name, device)(image0, image1)`` gives a mapping with ``matched_kpts0``, ``matched_kpts1`` (N, 2) and
perhaps ``matched_confidences`` (N,). It downloads the weights of a matcher when that is first used."""

import threading
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from fmtorch.core import lazy
from fmtorch.core.options import Within, nearest
from fmtorch.core.types import Correspondences, Features

CORNER = ("roma", "dkm")  # in the names of matchers whose first pixel's centre is at 0.5
EDGE = 0.5  # px from the first pixel's centre to the edge of the image
Image = NDArray[np.uint8]
Array = NDArray[np.float64]
Size = tuple[int, int]  # (h, w), px


class VisMatch:
    """The matches of two images by a matcher of vismatch.

    score: the confidence, where the matcher gives one. noise: where it gives a precision matrix for each match, as
    RoMa v2 does, see `relative_noise`. Matches outside of an image are masked. Calls take turns, each with torch's
    random numbers from the same seed: a pair's matches do not depend on the pairs before it.

    Args:
        name: of the matcher, as ``vismatch.available_models`` lists them.
        max_features: keypoints, or matches, at most; where the matcher knows such a bound.
        origin: coordinates of the first pixel's centre; None: 0.5 for RoMa's and DKM's kin, otherwise 0.
        device: auto, cpu, cuda.
        options: others, which the matcher's class takes.

    Raises:
        ImportError: where vismatch is not installed.
        ValueError: for a name that it does not know, and where the matcher cannot be loaded.
    """

    peer_package: ClassVar[str] = "vismatch"

    def __init__(
        self, name: str, max_features: Annotated[int, Within(1)] = 2048, origin: float | None = None,
        device: str = "auto", options: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        vismatch = lazy.imported("vismatch", "matcher=vismatch needs vismatch: pip install 'fmtorch[vismatch]'")
        known = [str(each) for each in getattr(vismatch, "available_models", [])]
        if known and name not in known:
            raise ValueError(f"matcher.name={name}: vismatch has no such matcher; there are: {nearest(name, known)}")
        automatic = "cuda" if torch.cuda.is_available() else "cpu"
        self.name, self.device = name, automatic if device == "auto" else device
        self.origin = (0.5 if any(word in name for word in CORNER) else 0.0) if origin is None else origin
        given = dict(options or {})
        try:
            self._matcher = vismatch.get_matcher(name, device=self.device, max_num_keypoints=max_features, **given)
        except Exception as error:  # whatever its imports, downloads and constructors raise
            raise ValueError(f"matcher.name={name}: vismatch cannot load it ({_described(error)})") from error
        self._sample = RecordedSample.of(self._matcher)
        self._turn = threading.Lock()
        self.identity = {"name": name, "max_features": max_features, "origin": self.origin, **given}
        if isinstance(self._matcher, torch.nn.Module):
            self.identity["network"] = self._matcher

    def __call__(self, features0: Features, features1: Features) -> Correspondences:
        """Raises ValueError: this matcher takes the images themselves."""
        raise ValueError(f"vismatch {self.name} matches images, not features; call match_images")

    def match_images(self, image0: Image, image1: Image) -> Correspondences:
        """The matches of two images (H, W) or RGB (H, W, 3), uint8: a batch of one, on the CPU.
        Raises ValueError, naming the matcher, where it fails or gives something else than it says."""
        sizes = [(image.shape[0], image.shape[1]) for image in (image0, image1)]
        with self._turn, torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            torch.manual_seed(0)
            try:
                result = self._matcher(*(_tensor(image).to(self.device) for image in (image0, image1)))
                return _correspondences(*self._matches(result, sizes), self.origin, sizes)
            except Exception as error:  # anybody's network
                raise ValueError(f"vismatch {self.name}: {_described(error)}") from error

    def _matches(
        self, result: Mapping[str, Any], sizes: Sequence[Size]
    ) -> tuple[Array, Array, Array | None, Array | None]:
        """Points (N, 2) of both images, and confidences and noise (N,) where the matcher gives them."""
        if self._sample is not None:
            x0, x1, overlap, precisions = self._sample.take(sizes)
            return x0, x1, overlap, relative_noise(*precisions)
        x0, x1 = (_numbers(result[f"matched_kpts{k}"]).reshape(-1, 2) for k in (0, 1))
        confidence = result.get("matched_confidences") if len(x0) else []  # those of no matches are known
        return x0, x1, None if confidence is None else _numbers(confidence).reshape(-1), None


def _correspondences(
    x0: Array, x1: Array, confidence: Array | None, noise: Array | None, origin: float, sizes: Sequence[Size]
) -> Correspondences:
    """A batch of one pair; matches that are not finite, or outside of an image, are masked.
    origin: coordinates of the first pixel's centre. sizes: (h, w) of the images. Raises ValueError for other lengths.
    """
    lengths = {len(part) for part in (x0, x1, confidence, noise) if part is not None}
    if len(lengths) > 1:
        raise ValueError(f"points and confidences of {', '.join(map(str, sorted(lengths)))} matches")
    x = [x0 - origin, x1 - origin]
    mask = np.ones(len(x[0]), bool)
    for points, (h, w) in zip(x, sizes, strict=True):
        with np.errstate(invalid="ignore"):  # NaN is in no image
            mask &= ((points >= -EDGE) & (points <= np.array([w, h]) - EDGE)).all(1)
    known = {"x0": np.where(mask[:, None], x[0], 0), "x1": np.where(mask[:, None], x[1], 0), "noise": noise}
    known["score"] = None if confidence is None else np.clip(np.nan_to_num(confidence), 0, 1)
    fields = {name: torch.from_numpy(v.astype(np.float32))[None] for name, v in known.items() if v is not None}
    size0, size1 = (torch.tensor([size]) for size in sizes)
    return Correspondences(**fields, mask=torch.from_numpy(mask)[None], size0=size0, size1=size1)


def _tensor(image: Image) -> Float[torch.Tensor, "3 h w"]:
    channels = np.broadcast_to(image if image.ndim == 3 else image[..., None], (*image.shape[:2], 3))
    return torch.from_numpy(channels.transpose(2, 0, 1).copy()).to(torch.float32) / 255


def _numbers(value: Any) -> Array:
    return np.asarray(value.detach().to(torch.float64).cpu() if isinstance(value, torch.Tensor) else value, np.float64)


def _described(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]


# How exact each match is, from the precision matrices that RoMa v2 gives with it

MAX_RATIO = 4.0  # of the noise of a match to the pair's usual one, either way: as far as frames tell (`match_noise`)


class RecordedSample:
    """The last matches that a RoMa v2 behind vismatch sampled, whose precisions vismatch does not hand on.
    ``sample`` of the released model gives matches (N, 4) in [-1, 1], overlaps (N,), and precision matrices (N, 2, 2) in
    the pixels of both images as the model saw them (Edstedt et al., 2025)."""

    def __init__(self, model: Any) -> None:
        self._model, self._sample = model, model.sample
        self._last: Sequence[Any] | None = None
        model.sample = self

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        self._last = self._sample(*arguments, **named)
        return self._last

    @classmethod
    def of(cls, matcher: Any) -> "RecordedSample | None":
        """Of a matcher of vismatch that is a RoMa v2; None for any other."""
        model = getattr(matcher, "romav2_model", None)
        return cls(model) if hasattr(model, "sample") and hasattr(model, "to_pixel_coordinates") else None

    def take(self, sizes: Sequence[tuple[int, int]]) -> tuple[Array, Array, Array, tuple[Array, Array]]:
        """The last sample: points (N, 2) of both images, overlaps (N,), and precisions (N, 2, 2) in pixels of both.
        sizes: (h, w) of the images. Raises ValueError where nothing was sampled, or without precisions."""
        last, self._last = self._last, None
        if last is None or len(last) != 4 or last[2] is None or last[3] is None:
            raise ValueError("the model sampled no matches with precisions")
        (h0, w0), (h1, w1) = sizes
        x0, x1 = self._model.to_pixel_coordinates(last[0], h0, w0, h1, w1)
        seen = (self._model.H_hr or self._model.H_lr, self._model.W_hr or self._model.W_lr)
        precisions = [_scaled(_numbers(p), seen, size) for p, size in zip(last[2:], sizes, strict=True)]
        return _numbers(x0), _numbers(x1), _numbers(last[1]).reshape(-1), (precisions[0], precisions[1])


def relative_noise(precision0: Array, precision1: Array) -> Array:
    """The noise of each match, in units of the pair's median, from precision matrices (N, 2, 2), 1 / px^2.
    The engine's noise is a standard deviation across an epipolar line. Over all directions n of that line the mean of
    the variance ``n^T C n`` of a covariance C is ``tr(C) / 2``: the noise is the square root of it, averaged over both
    images. (Equal determinants would be too sure of matches along an edge.) Within `MAX_RATIO` of the median; 1 where a
    precision is no positive matrix."""
    variance = (_mean_variance(precision0) + _mean_variance(precision1)) / 2
    valid = np.isfinite(variance)
    if not valid.any():
        return np.ones(len(variance))
    usual = np.median(np.sqrt(variance[valid]))
    noise = np.sqrt(np.where(valid, variance, usual**2)) / usual
    return np.asarray(np.clip(noise, 1 / MAX_RATIO, MAX_RATIO))


def _mean_variance(precision: Array) -> Array:
    """tr(P^-1) / 2 = tr(P) / (2 det P); NaN where P is not positive definite."""
    a, b, c, d = (precision[:, i, j] for i in (0, 1) for j in (0, 1))
    determinant = a * d - b * c
    positive = np.isfinite(precision).all((1, 2)) & (a > 0) & (determinant > 0)
    variance = np.full(len(precision), np.nan)
    variance[positive] = ((a + d)[positive] / determinant[positive]) / 2
    return variance


def _scaled(precision: Array, seen: tuple[int, int], size: tuple[int, int]) -> Array:
    """Precisions in pixels of an image of `size` (h, w), of which the model saw a copy of another size."""
    ratio = np.array([seen[1] / size[1], seen[0] / size[0]])
    return np.asarray(precision * ratio[:, None] * ratio)
