"""Two photographs of any size through a pipeline: their matches and fundamental matrix in their own pixels."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch import presets
from fmtorch.core.arguments import Arrays
from fmtorch.core.grey_pyramid import GreyPyramid, grey_pyramid
from fmtorch.core.stages import PairImages, pruned
from fmtorch.core.threads import mapped, one_thread
from fmtorch.core.types import RELATED, Correspondences, Estimate, Features
from fmtorch.data.images import to_grey
from fmtorch.geometry.verdict import judged
from fmtorch.pipeline.camera_arguments import Focal, camera_fields
from fmtorch.pipeline.clock import Clock
from fmtorch.pipeline.configuration import name_and_warning, still_warning
from fmtorch.pipeline.known_cameras import KnownCameras
from fmtorch.pipeline.pipeline import Pipeline
from fmtorch.pipeline.reduced_images import (
    Image,
    frames_to_original,
    fundamental_to_original,
    given_image,
    reduced_cameras,
    reduced_image,
    to_original,
)

NOTHING_KNOWN: Mapping[str, Tensor] = {}


@dataclasses.dataclass(frozen=True, eq=False)
class MatchResult:
    """The matches of two photographs and their fundamental matrix, ``x1^T F x0 = 0``, in pixels of the photographs.

    keypoints0, keypoints1: all that were detected, (N0, 2) and (N1, 2).
    putative: the matcher's matches, a batch of one. kept: which of them the pruners kept, (M,).
    correspondences: the kept ones, a batch of one. inliers: which of those agree with F, (K,).
    F: (3, 3) float64 of unit Frobenius norm; zero where there is none, and `reason` then says why.
    significance: how far the support of F is beyond chance (`fmtorch.geometry.significance`); -inf where there is no F.
    warning: why F, though found, means little; mostly empty. counts: matches after each step, in order. seconds: of
    each step, cached features with those they took when they were computed.
    R (3, 3), t (3,), focals (2,): X1 = R X0 + t with a t of unit length, and focal lengths in pixels of the
    photographs, where cameras were asked for; NaN where not determined. configuration: then one of `CONFIGURATIONS`.
    """

    keypoints0: Float[Tensor, "n0 2"]
    keypoints1: Float[Tensor, "n1 2"]
    putative: Correspondences
    kept: Bool[Tensor, " m"]
    correspondences: Correspondences
    inliers: Bool[Tensor, " k"]
    F: Float[Tensor, "3 3"]
    reason: str = ""
    warning: str = ""
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    significance: float = -math.inf
    R: Float[Tensor, "3 3"] | None = None
    t: Float[Tensor, " 3"] | None = None
    focals: Float[Tensor, " 2"] | None = None
    configuration: str = ""

    @property
    def related(self) -> bool:
        """Whether the photographs are taken to show one scene: F was found, and its support is beyond chance."""
        return self.ok and self.significance >= RELATED

    @property
    def ok(self) -> bool:
        """Whether a fundamental matrix was found."""
        return not self.reason


def match(
    image0: Path | str | Image,
    image1: Path | str | Image,
    *,
    pipeline: str | Pipeline = "hesaffnet_fmtorch",
    device: torch.device | str | None = None,
    longest_side: int = 1600,
    seed: int = 0,
    K0: Arrays | None = None,
    K1: Arrays | None = None,
    focal: Focal = None,
) -> MatchResult:
    """Match two photographs and estimate their fundamental matrix.

    Args:
        image0, image1: files, turned as their EXIF orientation says, or uint8 arrays, (H, W) or RGB (H, W, 3).
        pipeline: a preset of conf/pipeline, or a `Pipeline` (``presets.pipeline("sift_gms", overrides=[...])``).
        device: of a pipeline given by name; None: a GPU where there is one.
        longest_side: larger images are reduced to it for matching, and thresholds are in pixels of the reduced images;
            the results are always in pixels of the originals.
        seed: of sampling.
        K0, K1, focal: what is known of the cameras, in pixels of the photographs, as of `find_fundamental`.

    Returns:
        Matches, F and inliers in pixels of the originals. Photographs that cannot be related are no error: `related` is
        False, and mostly `ok` is True, since some F is found all the same. With K0, K1 or focal also the pose.

    Raises:
        ImageError: for a file that is no sound image.
        TypeError: for what is neither a path nor an array.
        ValueError: for an array of another type or shape, an unknown pipeline, a device that is not there, and for
            cameras as `find_fundamental`.

    Example:
        >>> import fmtorch, skimage.data
        >>> left, right, _ = skimage.data.stereo_motorcycle()
        >>> result = fmtorch.match(left, right, pipeline="sift_gms", longest_side=400)
        >>> result.ok, result.related, tuple(result.F.shape)
        (True, True, (3, 3))
    """
    if longest_side < 1:
        raise ValueError(f"longest_side is {longest_side}; it must be at least 1 px")
    if isinstance(pipeline, str):
        pipeline = _pipeline(pipeline, str(presets.resolve_device("auto" if device is None else str(device))))
    elif not isinstance(pipeline, Pipeline):
        raise TypeError(f"pipeline is a {type(pipeline).__name__}; it must be the name of a preset or a Pipeline")
    elif device is not None and torch.device(device) != pipeline.device:
        raise ValueError(f"device={device}, but the pipeline was built for {pipeline.device}; leave one of them out")
    images = [given_image(image, name) for image, name in ((image0, "image0"), (image1, "image1"))]
    cameras = camera_fields(K0, K1, focal, sizes_known=True)
    describing = functools.partial(describe, pipeline, longest_side=longest_side)
    at_once = functools.partial(mapped, share=True) if pipeline.device.type == "cpu" else map
    described0, described1 = at_once(describing, images)
    return relate(pipeline, described0, described1, seed, cameras)


@dataclasses.dataclass(frozen=True, eq=False)
class Described:
    """A photograph's features in pixels of it as it was reduced, the scale of that in x and y, and its size (h, w).

    seconds: that describing it takes or took. pyramid: its grey levels, for pruners that look at them.
    """

    features: Features
    scale: Float[Tensor, " xy"]
    size: tuple[int, int]
    seconds: float
    pyramid: GreyPyramid | None = None

    @property
    def points(self) -> Float[Tensor, "n 2"]:
        """The keypoints in pixels of the photograph."""
        return to_original(self.features.keypoints, self.scale.to(self.features.keypoints))


def describe(pipeline: Pipeline, image: Image, longest_side: int) -> Described:
    """The features of a photograph, for `relate`; see `match`."""
    reduced, scale = reduced_image(image, longest_side)
    features, seconds = pipeline.extract(reduced)
    pyramid = grey_pyramid(to_grey(reduced)) if pipeline.looks_at_images else None
    return Described(features, scale, (image.shape[0], image.shape[1]), seconds, pyramid)


def relate(
    pipeline: Pipeline, described0: Described, described1: Described, seed: int = 0,
    cameras: Mapping[str, Tensor] = NOTHING_KNOWN,
) -> MatchResult:  # fmt: skip
    """What `match` finds of two photographs that are described already. cameras: of `camera_fields`."""
    clock = Clock(pipeline.device)
    clock("features", described0.seconds + described1.seconds)
    scales = [described0.scale, described1.scale]
    known = reduced_cameras(cameras, scales, [described0.size, described1.size])
    known = {name: value.to(pipeline.device) for name, value in known.items()}
    result = _relate(pipeline, (described0, described1), seed, clock, known)
    sizes = [torch.tensor([d.size], device=pipeline.device) for d in (described0, described1)]
    return _restored(result, scales, sizes)


@functools.lru_cache(maxsize=8)
def _pipeline(name: str, device: str) -> Pipeline:
    built: Pipeline = presets.pipeline(name, device)
    return built


def _relate(
    pipeline: Pipeline, described: Sequence[Described], seed: int, clock: Clock, cameras: dict[str, Tensor]
) -> MatchResult:
    """Matching, pruning and estimation, in pixels of the images as they were described."""
    features0, features1 = (each.features for each in described)
    images = cast(PairImages, tuple(each.pyramid for each in described))
    ends = features0.keypoints, features1.keypoints
    nothing = Correspondences(ends[0][None, :0], ends[1][None, :0], features0.valid[None, :0])
    nothing_found = MatchResult(
        *ends, nothing, nothing.mask[0], nothing, nothing.mask[0], ends[0].new_zeros(3, 3, dtype=torch.float64)
    )
    empty = [f"image{i}" for i in (0, 1) if len(ends[i]) == 0]
    if empty:
        reason = f"no keypoints in {' and '.join(empty)}: too small, or without texture"
        return dataclasses.replace(nothing_found, reason=reason, seconds=clock.seconds)
    putative = c = pipeline.matcher(features0, features1)
    clock("matching")
    counts = {"matching": int(c.count())}
    slots = torch.arange(c.mask.shape[1], device=c.mask.device)
    for name, pruner in pipeline.pruners.items():
        with one_thread(pipeline.device):
            c = pruned(pruner, c, lambda _: images)
        slots, c = slots[c.mask[0]], c.compact()
        clock(name)
        counts[name] = len(slots)
    kept = torch.zeros_like(putative.mask[0]).index_fill(0, slots, True)
    estimator = KnownCameras(pipeline.estimator) if cameras else pipeline.estimator
    given = c.replace(**cameras)
    estimate: Estimate = judged(estimator(given, seed).detach(), c)
    clock("estimation")
    configuration, warning = name_and_warning(estimate, given, seed) if cameras else ("", "")
    inliers = estimate.inliers[0]
    counts["estimation"] = int(inliers.sum())
    R, t, focals = (None if value is None else value[0] for value in (estimate.R, estimate.t, estimate.focals))
    return MatchResult(
        *ends, putative, kept, c, inliers, estimate.F[0].to(torch.float64), estimate.reason[0],
        still_warning(c, inliers) or warning, counts, clock.seconds, float(cast(Tensor, estimate.significance)[0]),
        R, t, focals, configuration,
    )  # fmt: skip


def _restored(result: MatchResult, scales: list[Tensor], sizes: list[Tensor]) -> MatchResult:
    """The result in pixels of the original images of these sizes, whose reduction had these scales."""
    s0, s1 = (s.to(result.keypoints0) for s in scales)

    def matches(c: Correspondences) -> Correspondences:
        return c.replace(
            x0=to_original(c.x0, s0), x1=to_original(c.x1, s1),
            lafs0=frames_to_original(c.lafs0, s0), lafs1=frames_to_original(c.lafs1, s1),
            size0=sizes[0], size1=sizes[1],
        )  # fmt: skip

    return dataclasses.replace(
        result,
        keypoints0=to_original(result.keypoints0, s0), keypoints1=to_original(result.keypoints1, s1),
        putative=matches(result.putative), correspondences=matches(result.correspondences),
        F=fundamental_to_original(result.F, *scales),
        focals=None if result.focals is None else result.focals / torch.stack(scales).prod(1).sqrt().to(result.focals),
    )  # fmt: skip
