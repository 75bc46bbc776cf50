"""Any matcher of the package vismatch (extra `vismatch`): two images in, matched points out, without features of ours.

The package (github.com/gmberton/vismatch, formerly image-matching-models) has one call for all of its matchers:
``get_matcher(name, device)(image0, image1)`` gives a mapping with ``matched_kpts0``, ``matched_kpts1`` (N, 2) and
perhaps ``matched_confidences`` (N,). It downloads the weights of a matcher when that is first used; nothing is
downloaded here.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, NamedTuple, overload

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.options import Within, nearest
from fmtorch.core.types import Correspondences, Features
from fmtorch.matching.matcher import RecordedSample, relative_noise

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
        self,
        name: str,
        max_features: Annotated[int, Within(1)] = 2048,
        origin: float | None = None,
        device: str = "auto",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        try:
            vismatch = importlib.import_module("vismatch")
        except ImportError as error:
            raise ImportError("matcher=vismatch needs vismatch: pip install 'fmtorch[vismatch]'") from error
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

        Raises ValueError, naming the matcher, where it fails or gives something else than it says.
        """
        sizes = [(image.shape[0], image.shape[1]) for image in (image0, image1)]
        with self._turn, torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            torch.manual_seed(0)
            try:
                result = self._matcher(*(_tensor(image).to(self.device) for image in (image0, image1)))
                return _correspondences(self._matches(result, sizes), self.origin, sizes)
            except Exception as error:  # anybody's network
                raise ValueError(f"vismatch {self.name}: {_described(error)}") from error

    def _matches(self, result: Mapping[str, Any], sizes: Sequence[Size]) -> _Matches:
        if self._sample is not None:
            x0, x1, overlap, precisions = self._sample.take(sizes)
            return _Matches(x0, x1, overlap, relative_noise(*precisions))
        x0, x1 = (_numbers(result[f"matched_kpts{k}"]).reshape(-1, 2) for k in (0, 1))
        confidence = result.get("matched_confidences") if len(x0) else []  # those of no matches are known
        return _Matches(x0, x1, None if confidence is None else _numbers(confidence).reshape(-1))


class _Matches(NamedTuple):
    """Points (N, 2) of both images, and confidences and noise (N,) where the matcher gives them."""

    x0: Array
    x1: Array
    confidence: Array | None
    noise: Array | None = None


def _correspondences(matches: _Matches, origin: float, sizes: Sequence[Size]) -> Correspondences:
    """A batch of one pair; matches that are not finite, or outside of an image, are masked.

    origin: coordinates of the first pixel's centre. sizes: (h, w) of the images. Raises ValueError for other lengths.
    """
    lengths = {len(part) for part in matches if part is not None}
    if len(lengths) > 1:
        raise ValueError(f"points and confidences of {', '.join(map(str, sorted(lengths)))} matches")
    x = [matches.x0 - origin, matches.x1 - origin]
    mask = np.ones(len(x[0]), bool)
    for points, (h, w) in zip(x, sizes, strict=True):
        with np.errstate(invalid="ignore"):  # NaN is in no image
            mask &= ((points >= -EDGE) & (points <= np.array([w, h]) - EDGE)).all(1)
    x0, x1 = (_batch(np.where(mask[:, None], points, 0)) for points in x)
    score = None if matches.confidence is None else np.clip(np.nan_to_num(matches.confidence), 0, 1)
    size0, size1 = (torch.tensor([size]) for size in sizes)
    return Correspondences(
        x0, x1, torch.from_numpy(mask)[None], score=_batch(score), noise=_batch(matches.noise),
        size0=size0, size1=size1,
    )  # fmt: skip


@overload
def _batch(values: Array) -> Tensor: ...
@overload
def _batch(values: Array | None) -> Tensor | None: ...
def _batch(values: Array | None) -> Tensor | None:
    return None if values is None else torch.from_numpy(values.astype(np.float32))[None]


def _tensor(image: Image) -> Float[Tensor, "3 h w"]:
    """An image as vismatch takes it: RGB, in [0, 1]."""
    channels = np.broadcast_to(image if image.ndim == 3 else image[..., None], (*image.shape[:2], 3))
    return torch.from_numpy(channels.transpose(2, 0, 1).copy()).to(torch.float32) / 255


def _numbers(value: Any) -> NDArray[np.float64]:
    return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value, np.float64)


def _described(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]
