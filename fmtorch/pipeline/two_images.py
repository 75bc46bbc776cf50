"""Photographs described for matching: features of each as it was reduced, and what leads back to it."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fmtorch import presets
from fmtorch.core.stages import GreyPyramid, ImageMatcher, NoFeatures, PairImages, grey_pyramid, output_of, pruned
from fmtorch.core.types import Correspondences, Features
from fmtorch.data import Lens, to_grey
from fmtorch.jobs.execution import mapped, one_thread
from fmtorch.pipeline import photographs
from fmtorch.pipeline.match_result import Lenses, MatchResult
from fmtorch.pipeline.pair_geometries import pair_geometries
from fmtorch.pipeline.photographs import GivenImage, Image, frames_to_original, to_original
from fmtorch.pipeline.pipeline import Clock, Pipeline, load_pipeline
from fmtorch.two_view.arguments import Arrays, Focal, camera_fields, lens_fields
from fmtorch.two_view.arguments import Lens as Division
from fmtorch.two_view.estimation import expect_lenses
from fmtorch.two_view.known_cameras import KnownCameras
from fmtorch.two_view.pair_type import (
    classify,
    compile_with,
    still_warning,
    warnings_of,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Described:
    """A photograph's features in pixels of it as it was reduced, the scale of that in x and y, and its size (h, w).

    seconds: that describing it takes or took. pyramid: its grey levels, for pruners that look at them. image: reduced,
    for a matcher that takes the images themselves, and has no features.
    """

    features: Features
    scale: Float[Tensor, " xy"]
    size: tuple[int, int]
    seconds: float
    pyramid: GreyPyramid | None = None
    image: Image | None = None

    @property
    def points(self) -> Float[Tensor, "n 2"]:
        return to_original(self.features.keypoints, self.scale.to(self.features.keypoints))


def describe(pipeline: Pipeline, image: Image, longest_side: int) -> Described:
    """The features of a photograph, for `relate`; see `match`."""
    reduced, scale = photographs.reduced_image(image, longest_side)
    itself = isinstance(pipeline.matcher, ImageMatcher)
    features, seconds = (NoFeatures()(reduced), 0.0) if itself else pipeline.extract(reduced)
    pyramid = grey_pyramid(to_grey(reduced)) if pipeline.looks_at_images else None
    return Described(features, scale, (image.shape[0], image.shape[1]), seconds, pyramid, reduced if itself else None)


# Two photographs of any size through a pipeline: their matches and fundamental matrix in their own pixels


NOTHING_KNOWN: Mapping[str, Tensor] = {}
NO_CAMERAS: Mapping[str, None] = dict.fromkeys(("K0", "K1", "focal", "shared_focal"))  # of the reduced images


def match(
    image0: GivenImage,
    image1: GivenImage,
    *,
    pipeline: str | Pipeline = "hesaffnet_fast_fmtorch",
    device: torch.device | str | None = None,
    longest_side: int = 1600,
    seed: int = 0,
    K0: Arrays | None = None,
    K1: Arrays | None = None,
    focal: Focal = None,
    lens: Division = None,
    lens0: Lens | None = None,
    lens1: Lens | None = None,
) -> MatchResult:
    """Match two photographs and estimate their fundamental matrix.

    Args:
        image0, image1: files, turned as their EXIF orientation says, images of Pillow as they are, or uint8 arrays,
            (H, W) or RGB (H, W, 3).
        pipeline: a preset of conf/pipeline, or a `Pipeline` (``load_pipeline("sift_gms", overrides=[...])``).
        device: of a pipeline given by name; None: a GPU where there is one.
        longest_side: larger images are reduced to it for matching, and thresholds are in pixels of the reduced images;
            the results are always in pixels of the originals.
        seed: of sampling.
        K0, K1, focal: what is known of the cameras, in pixels of the photographs, as of `find_fundamental`.
        lens: how much lenses bend straight lines that nobody calibrated, as of `find_fundamental`: "shared", "unknown",
            or lambda. What is estimated is in `lens`, F relates undistorted points, as with lens0 and lens1.
        lens0, lens1: lenses that distort, whose calibrations stand for K0 and K1. Features are those of the
            photographs; matches are undistorted before the estimator, and F relates undistorted points.

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
    images = [photographs.given_image(image, name) for image, name in ((image0, "image0"), (image1, "image1"))]
    K0, K1 = (K if lens is None else lens.K for K, lens in ((K0, lens0), (K1, lens1)))
    if lens is not None:
        expect_lenses(pipeline.estimator, type(pipeline.estimator).__name__)
    if lens is not None and (lens0 is not None or lens1 is not None):
        raise ValueError("lens and lens0 or lens1 are given; a lens is estimated or calibrated: leave one of them out")
    cameras = camera_fields(K0, K1, focal, sizes_known=True)
    describing = functools.partial(describe, pipeline, longest_side=longest_side)
    at_once = functools.partial(mapped, share=True) if pipeline.device.type == "cpu" else map
    described0, described1 = at_once(describing, images)
    result = relate(pipeline, described0, described1, seed, cameras | lens_fields(lens), (lens0, lens1))
    return dataclasses.replace(result, photographs=(image0, image1))


def relate(
    pipeline: Pipeline, described0: Described, described1: Described, seed: int = 0,
    cameras: Mapping[str, Tensor] = NOTHING_KNOWN, lenses: Lenses = (None, None),
) -> MatchResult:  # fmt: skip
    """What `match` finds of two photographs that are described already.

    cameras: of `camera_fields` and `lens_fields`. lenses: those that are calibrated.
    """
    compile_with([*pipeline.pruners.values(), pipeline.estimator])
    clock = Clock(pipeline.device)
    clock("features", described0.seconds + described1.seconds)
    scales = [described0.scale, described1.scale]
    known = photographs.reduced_cameras(cameras, scales, [described0.size, described1.size])
    known = {name: value.to(pipeline.device) for name, value in known.items()}
    result = dataclasses.replace(_matched(pipeline, (described0, described1), clock), lenses=lenses)
    if not result.reason:
        c = result.correspondences
        c = photographs.undistorted_matches(c, lenses, scales).replace(**known)
        result = _estimated(pipeline, result, c, scales, seed, clock)
    if not any(lens is not None and lens.bends for lens in result.lenses):
        result = dataclasses.replace(result, undistorted=None)
    sizes = [torch.tensor([d.size], device=pipeline.device) for d in (described0, described1)]
    return _restored(result, scales, sizes)


@functools.lru_cache(maxsize=8)
def _pipeline(name: str, device: str) -> Pipeline:
    return load_pipeline(name, device)


def _matched(pipeline: Pipeline, described: Sequence[Described], clock: Clock) -> MatchResult:
    """Matching and pruning, in pixels of the images as they were described; a reason where there are no keypoints."""
    features0, features1 = (each.features for each in described)
    putative = _of_images(pipeline, described)
    images = cast(PairImages, tuple(each.pyramid for each in described))
    ends = features0.keypoints, features1.keypoints
    if putative is not None:
        ends = putative.x0[0][putative.mask[0]], putative.x1[0][putative.mask[0]]
    none = torch.zeros(1, 0, dtype=torch.bool, device=ends[0].device)
    nothing = Correspondences(ends[0][None, :0], ends[1][None, :0], none)
    nothing_found = MatchResult(
        *ends, nothing, nothing.mask[0], nothing, nothing.mask[0], ends[0].new_zeros(3, 3, dtype=torch.float64)
    )
    empty = [f"image{i}" for i in (0, 1) if len(ends[i]) == 0]
    if empty:
        reason = f"no keypoints in {' and '.join(empty)}: too small, or without texture"
        reason = reason if putative is None else "the matcher finds no matches"
        return dataclasses.replace(nothing_found, reason=reason, seconds=clock.seconds)
    if putative is None:
        putative = pipeline.matched(features0, features1)
    c = putative
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
    return dataclasses.replace(nothing_found, putative=putative, kept=kept, correspondences=c, counts=counts)


def _of_images(pipeline: Pipeline, described: Sequence[Described]) -> Correspondences | None:
    image0, image1 = (each.image for each in described)
    if not isinstance(pipeline.matcher, ImageMatcher) or image0 is None or image1 is None:
        return None
    matches = pipeline.matcher.match_images(image0, image1)
    return output_of(pipeline.matcher, matches, Correspondences).to(pipeline.device)


def _estimated(
    pipeline: Pipeline, matched: MatchResult, c: Correspondences, scales: list[Tensor], seed: int, clock: Clock
) -> MatchResult:
    """The result with an estimate. c: the matches as pinholes have them, with what is known of the cameras."""
    estimator = KnownCameras(pipeline.estimator) if c.asks_for_cameras else pipeline.estimator
    estimate = pipeline.estimated(c, seed, estimator)
    clock("estimation")
    lenses = matched.lenses
    if estimate.lens is not None:
        lenses = photographs.division_lenses(estimate.lens[0], c, scales)
        c = photographs.undistorted_matches(c, lenses, scales).derived(lens=None, shared_lens=None)
    even, F, even_scales = photographs.evenly_reduced(c, estimate.F, scales)
    pair_type = classify(even, estimate.derived(F=F), seed=seed)
    clock("pair_type")
    index = np.arange(c.mask.shape[1]).repeat(2).reshape(-1, 2)
    (geometry,) = pair_geometries([index], even, estimate.derived(F=F), pair_type)
    inliers = estimate.inliers[0]
    cameras = estimate.R, estimate.t, estimate.focals, estimate.lens
    R, t, focals, lens = (None if value is None else value[0] for value in cameras)
    return dataclasses.replace(
        matched, inliers=inliers, F=estimate.F[0].to(torch.float64), reason=estimate.reason[0],
        warning=still_warning(matched.correspondences, inliers) or warnings_of(estimate, pair_type)[0],
        counts={**matched.counts, "estimation": int(inliers.sum())}, seconds=clock.seconds,
        significance=float(cast(Tensor, estimate.significance)[0]), R=R, t=t, focals=focals, lens=lens,
        pair_type=pair_type.names[0], geometry=photographs.geometry_to_original(geometry, *even_scales), undistorted=c,
        lenses=lenses,
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

    undistorted = None if result.undistorted is None else matches(result.undistorted).derived(**NO_CAMERAS)
    return dataclasses.replace(
        result,
        keypoints0=to_original(result.keypoints0, s0), keypoints1=to_original(result.keypoints1, s1),
        putative=matches(result.putative), correspondences=matches(result.correspondences), undistorted=undistorted,
        F=photographs.fundamental_to_original(result.F, *scales),
        focals=None if result.focals is None else result.focals / torch.stack(scales).prod(1).sqrt().to(result.focals),
    )  # fmt: skip
