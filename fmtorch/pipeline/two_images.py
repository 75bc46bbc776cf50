"""Two photographs of any size through a pipeline: their matches and F in their own pixels, with pictures and files."""

import dataclasses
import functools
import html
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, cast, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fmtorch import presets
from fmtorch.core import RELATED, Correspondences, Features, checks, files, stages
from fmtorch.data import Lens, to_grey, undistorted
from fmtorch.io.match_store import PairGeometry
from fmtorch.jobs.execution import mapped, one_thread
from fmtorch.pipeline import photographs, pictures
from fmtorch.pipeline.photographs import GivenImage, Image, frames_to_original, given_image, to_original
from fmtorch.pipeline.pipeline import Clock, Pipeline, load_pipeline
from fmtorch.two_view import arguments
from fmtorch.two_view.lenses import CalibratedLenses
from fmtorch.two_view.pair_type import classify, compile_with, still_warning, warnings_of

FLAT = ("planar", "rotation", "identical")  # pair types of which a homography explains all matches
Picture = Literal["matches", "pruning", "epipolar"]
Lenses = tuple[Lens | None, Lens | None]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MatchResult:
    """The matches of two photographs and their fundamental matrix, ``x1^T F x0 = 0``, in pixels of the photographs.

    keypoints0, keypoints1: all that were detected, (N0, 2) and (N1, 2).
    putative: the matcher's matches, a batch of one. kept: which of them the pruners kept, (M,).
    correspondences: the kept ones, a batch of one. inliers: which of those agree with F, (K,).
    F: (3, 3) float64 of unit Frobenius norm; zero where there is none, and `reason` then says why.
    significance: how far the support of F is beyond chance (`fmtorch.geometry.significance`); -inf where there is no F.
    warning: why F, though found, means little; usually empty. counts: matches after each step, in order. seconds: of
    each step; of cached features, those they took when they were computed.
    R (3, 3), t (3,), focals (2,): X1 = R X0 + t with a t of unit length, and focal lengths in pixels of the
    photographs, where cameras were asked for; NaN where not determined.
    pair_type: one of `PAIR_TYPES`; empty where nothing could be matched. geometry: the two-view geometry for
    COLMAP, whose inliers are indices of the kept matches, twice. undistorted: where a lens distorts, the kept matches
    as pinholes would have them, which F and homography relate; points are otherwise those of the photographs.
    lens: (2,), lambda of both lenses as of `Estimate.lens`, where these were estimated.
    photographs: as they were given, lenses: as they are known or were estimated; for pictures."""

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
    lens: Float[Tensor, " 2"] | None = None
    pair_type: str = ""
    geometry: PairGeometry | None = None
    undistorted: Correspondences | None = None
    photographs: tuple[GivenImage, GivenImage] | None = None
    lenses: Lenses = (None, None)

    @property
    def homography(self) -> Float[Tensor, "3 3"] | None:
        """Of planes, rotations and copies: ``x1 ~ H x0`` in pixels of the photographs; else None."""
        H = None if self.geometry is None or self.pair_type not in FLAT else self.geometry.H
        return None if H is None else torch.from_numpy(H)

    @property
    def related(self) -> bool:
        """Whether the photographs are taken to show one scene: F was found, and its support is beyond chance."""
        return self.ok and self.significance >= RELATED

    @property
    def ok(self) -> bool:
        """Whether a fundamental matrix was found."""
        return not self.reason

    def draw(self, what: Picture = "matches", *, truth: arguments.Arrays | None = None) -> Image:
        """A picture of both photographs, RGB (H, W, 3).

        Args:
            what: "matches", of which inliers are green; "pruning", what was kept; "epipolar", inliers with their lines.
            truth: the true F (3, 3), whose epipolar lines are dashed; they are drawn alone where no F was found.

        Raises:
            ValueError: for another picture, and for epipolar lines where there is no F.
        """
        if what not in get_args(Picture):
            raise ValueError(f"what is {what!r}; it must be one of {', '.join(get_args(Picture))}")
        if what == "epipolar":
            return self._epipolar(truth, None)
        kept = self.kept.cpu().numpy()
        good, names = kept.copy(), ("kept", "dropped by pruning")
        if what == "pruning":
            names = (f"kept by pruning ({', '.join(self._pruners)})", "dropped")
        elif self.ok:
            good[good] = self.inliers.cpu().numpy()
            names = ("inliers of F", "others, dropped by pruning or estimation")
        picture = pictures.draw_matches(*self._images(), self.putative.x0[0], self.putative.x1[0], good, names=names)
        return pictures.headed(picture, *self._verdict)

    def save(
        self, folder: Path | str, *, truth: arguments.Arrays | None = None, report: Mapping[str, Any] | None = None
    ) -> list[str]:
        """Write `result.json` and the pictures into a folder, as `fmtorch match` does; the names of the files.

        Args:
            folder: made where it is missing.
            truth: as of `draw`.
            report: further entries of `result.json`.
        """
        folder = Path(folder)
        if folder.is_file():
            raise ValueError(f"folder={folder} is a file; give a folder, for several files")
        folder.mkdir(parents=True, exist_ok=True)
        drawn = {"matches": True, "pruning": bool(self._pruners), "epipolar": self.ok or truth is not None}
        names = [name for name in get_args(Picture) if drawn[name]]
        files.write_whole(folder / "result.json", json.dumps({**(report or {}), **self.report()}) + "\n")
        for name in get_args(Picture):
            path = folder / f"{name}.png"
            if name not in names:  # of an earlier run
                path.unlink(missing_ok=True)
                continue
            nsgd = (report or {}).get("nsgd")
            picture = self._epipolar(truth, nsgd) if name == "epipolar" else self.draw(name)
            files.write_whole(path, cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
        return ["result.json", *(f"{name}.png" for name in names)]

    def report(self) -> dict[str, Any]:
        """What result.json holds: plain values, points in pixels of the photographs."""
        c, H = self.correspondences, self.homography
        report: dict[str, Any] = {
            "size0": _plain(c.size0), "size1": _plain(c.size1),
            "F": self.F.tolist() if self.ok else None, "reason": self.reason, "warning": self.warning,
            "pair_type": self.pair_type or None, "homography": None if H is None else H.tolist(),
            "related": self.related, "significance": self.significance if math.isfinite(self.significance) else None,
            "features": [len(self.keypoints0), len(self.keypoints1)], "matches": self.counts, "seconds": self.seconds,
            "x0": c.x0[0].tolist(), "x1": c.x1[0].tolist(), "inliers": self.inliers.tolist(),
            "ratio": _plain(c.ratio), "score": _plain(c.score),
        }  # fmt: skip
        if (pinhole := self.undistorted) is not None:
            report |= {"undistorted_x0": pinhole.x0[0].tolist(), "undistorted_x1": pinhole.x1[0].tolist()}
        if self.R is not None and self.t is not None and self.focals is not None:
            determined = self.ok and bool(torch.isfinite(self.R).all())
            report |= {name: value.tolist() if determined else None for name, value in (("R", self.R), ("t", self.t))}
            report["focals"] = [focal if math.isfinite(focal) else None for focal in self.focals.tolist()]
        if self.lens is not None:
            report["lens"] = [value if math.isfinite(value) else None for value in self.lens.tolist()]
        return report

    def __repr__(self) -> str:
        found = [files.counted(len(self.inliers), "match")]
        if not self.ok:
            return f"MatchResult({found[0]}, no F: {self.reason})"
        verdict = "related" if self.related else "not related"
        found += [f"{int(self.inliers.sum())} inliers", f"significance {self.significance:.1f}", verdict]
        found += [self.pair_type] if self.pair_type not in ("", "unrelated") else []
        return f"MatchResult({', '.join(found)})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the line, and the picture of the matches where the photographs are at hand."""
        line = f"<p>{html.escape(repr(self))}</p>"
        if self.photographs is None:
            return line
        return f'{line}<img src="{pictures.jpeg_url(self.draw())}" alt="matches" style="max-width: 100%">'

    @property
    def _pruners(self) -> list[str]:
        return [step for step in self.counts if step not in ("matching", "estimation")]

    def _images(self) -> tuple[Image, Image]:
        if self.photographs is None:
            raise ValueError("the photographs are not at hand; fmtorch.draw_matches draws matches into any two images")
        image0, image1 = (given_image(image, f"image{i}") for i, image in enumerate(self.photographs))
        return image0, image1

    @property
    def _verdict(self) -> tuple[str, bool]:
        """What pictures say of the pair, and whether it is not to be relied on."""
        if not self.ok:
            return f"no F: {self.reason}", True
        if self.pair_type in FLAT:
            return f"{self.pair_type}: these matches do not determine F", True
        if not self.related:
            return f"not related: so many inliers agree by chance (significance {self.significance:.1f})", True
        return f"related, {self.pair_type or 'general'}", False

    def _epipolar(self, truth: arguments.Arrays | None, nsgd: float | None) -> Image:
        if not self.ok and truth is None:
            raise ValueError(f"there are no epipolar lines without F: {self.reason}")
        seen = self.correspondences if self.undistorted is None else self.undistorted
        good = self.inliers if self.ok else seen.mask[0]
        bent = zip(self._images(), self.lenses, strict=True)
        image0, image1 = (image if lens is None else undistorted(image, lens) for image, lens in bent)
        F = self.F if self.ok or truth is None else truth
        dashed = truth if self.ok else None
        picture = pictures.draw_epipolar_lines(image0, image1, seen.x0[0][good], seen.x1[0][good], F, truth=dashed)
        said, doubtful = self._verdict
        said += "; a point and the line of its partner have one colour"
        said += "" if dashed is None else "; dashed white: true lines"
        return pictures.headed(picture, said + ("" if nsgd is None else f"; NSGD {nsgd:.4f}"), doubtful)


def _plain(value: Tensor | None) -> Any:
    return None if value is None else value[0].tolist()


@dataclasses.dataclass(frozen=True, eq=False)
class Described:
    """A photograph's features in pixels of it as it was reduced, the scale of that in x and y, and its size (h, w).
    seconds: of describing it. pyramid: grey levels, for pruners. image: reduced, for a matcher of images themselves."""

    features: Features
    scale: Float[Tensor, " xy"]
    size: tuple[int, int]
    seconds: float
    pyramid: stages.GreyPyramid | None = None
    image: Image | None = None

    @property
    def points(self) -> Float[Tensor, "n 2"]:
        return to_original(self.features.keypoints, self.scale.to(self.features.keypoints))


def describe(pipeline: Pipeline, image: Image, longest_side: int) -> Described:
    """The features of a photograph, for `relate`; see `match`."""
    reduced, scale = photographs.reduced_image(image, longest_side)
    itself = isinstance(pipeline.matcher, stages.ImageMatcher)
    features, seconds = (stages.NoFeatures()(reduced), 0.0) if itself else pipeline.extract(reduced)
    pyramid = stages.grey_pyramid(to_grey(reduced)) if pipeline.looks_at_images else None
    return Described(features, scale, (image.shape[0], image.shape[1]), seconds, pyramid, reduced if itself else None)


NOTHING_KNOWN: Mapping[str, Tensor] = {}
NO_CAMERAS: Mapping[str, None] = dict.fromkeys(("K0", "K1", "focal", "shared_focal"))  # of the reduced images


def match(
    image0: GivenImage, image1: GivenImage, *, pipeline: str | Pipeline = "hesaffnet_fast_fmtorch",
    device: torch.device | str | None = None, longest_side: int = 1600, seed: int = 0,
    K0: arguments.Arrays | None = None, K1: arguments.Arrays | None = None, focal: arguments.Focal = None,
    lens: arguments.Lens = None,
) -> MatchResult:  # fmt: skip
    """Match two photographs and estimate their fundamental matrix; with K0, K1 or focal also their relative pose.

    Photographs that cannot be related are no error: `related` is False, and mostly `ok` is True, since some F is found.

    Args:
        image0, image1: files, turned as EXIF says, images of Pillow as they are, or uint8 arrays (H, W), RGB (H, W, 3).
        pipeline: a preset of conf/pipeline, or a `Pipeline` (``load_pipeline("sift_gms", overrides=[...])``).
        device: of a pipeline given by name; None: a GPU where there is one.
        longest_side: larger images are reduced to it for matching, and thresholds are in pixels of the reduced images;
            the results are always in pixels of the originals.
        seed: of sampling.
        K0, K1, focal: what is known of the cameras, in pixels of the photographs, as of `find_fundamental`.
        lens: as of `find_fundamental`, of one pair. Features are those of the photographs; matches are undistorted
            before estimation where lenses are calibrated: F relates undistorted points.

    Raises:
        ImageError: for a file that is no sound image.
        TypeError: for what is neither a path nor an array.
        ValueError: for an array of another type or shape, an unknown pipeline or device, and as `find_fundamental`.

    Example:
        >>> import fmtorch, skimage.data
        >>> left, right, _ = skimage.data.stereo_motorcycle()
        >>> result = fmtorch.match(left, right, pipeline="sift_gms", longest_side=400)
        >>> result.ok, result.related, tuple(result.F.shape)
        (True, True, (3, 3))
    """
    if checks.number("longest_side", longest_side, integer=True) < 1:
        raise ValueError(f"longest_side is {longest_side}; it must be at least 1 px")
    if isinstance(pipeline, str):
        pipeline = _pipeline(pipeline, str(presets.resolve_device("auto" if device is None else str(device))))
    elif not isinstance(pipeline, Pipeline):
        raise TypeError(f"pipeline is a {type(pipeline).__name__}; it must be the name of a preset or a Pipeline")
    elif device is not None and torch.device(device) != pipeline.device:
        raise ValueError(f"device={device}, but the pipeline was built for {pipeline.device}; leave one of them out")
    images = [photographs.given_image(image, name) for image, name in ((image0, "image0"), (image1, "image1"))]
    lenses: Lenses = (None, None)
    if arguments.is_calibrated(lens):
        calibrated = CalibratedLenses(lens, None, K0, K1)
        lenses, lens, (K0, K1) = calibrated.pairs[0], None, calibrated.K
    if lens is not None:
        arguments.expect_lenses(pipeline.estimator, type(pipeline.estimator).__name__)
        arguments.expect_lens(lens)
    cameras = arguments.camera_fields(K0, K1, focal, sizes_known=True)
    describing = functools.partial(describe, pipeline, longest_side=longest_side)
    at_once = functools.partial(mapped, share=True) if pipeline.device.type == "cpu" else map
    described0, described1 = at_once(describing, images)
    result = relate(pipeline, described0, described1, seed, cameras | arguments.lens_fields(lens), lenses)
    return dataclasses.replace(result, photographs=(image0, image1))


def relate(
    pipeline: Pipeline, described0: Described, described1: Described, seed: int = 0,
    cameras: Mapping[str, Tensor] = NOTHING_KNOWN, lenses: Lenses = (None, None),
) -> MatchResult:  # fmt: skip
    """What `match` finds of two photographs that are described already.

    cameras: of `camera_fields` and `lens_fields`. lenses: those that are calibrated."""
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


_pipeline = functools.lru_cache(maxsize=8)(load_pipeline)


def _matched(pipeline: Pipeline, described: Sequence[Described], clock: Clock) -> MatchResult:
    """Matching and pruning, in pixels of the images as they were described; a reason where there are no keypoints."""
    images = cast(stages.PairImages, tuple(each.pyramid for each in described))
    keypoints0, keypoints1 = (each.features.keypoints for each in described)
    ends, putative = (keypoints0, keypoints1), None
    if isinstance(pipeline.matcher, stages.ImageMatcher):
        putative = pipeline.matched(*(each.image for each in described))
        ends = putative.x0[0][putative.mask[0]], putative.x1[0][putative.mask[0]]
    none = torch.zeros(1, 0, dtype=torch.bool, device=ends[0].device)
    nothing = Correspondences(ends[0][None, :0], ends[1][None, :0], none)
    no_F = ends[0].new_zeros(3, 3, dtype=torch.float64)
    nothing_found = MatchResult(*ends, nothing, nothing.mask[0], nothing, nothing.mask[0], no_F)
    empty = [f"image{i}" for i in (0, 1) if len(ends[i]) == 0]
    if empty:
        reason = f"no keypoints in {' and '.join(empty)}: too small, or without texture"
        reason = reason if putative is None else "the matcher finds no matches"
        return dataclasses.replace(nothing_found, reason=reason, seconds=clock.seconds)
    if putative is None:
        putative = pipeline.matched(*(each.features for each in described))
    c = putative
    clock("matching")
    counts = {"matching": int(c.count())}
    slots = torch.arange(c.mask.shape[1], device=c.mask.device)
    for name, pruner in pipeline.pruners.items():
        with one_thread(pipeline.device):
            c = stages.pruned(pruner, c, lambda _: images)
        slots, c = slots[c.mask[0]], c.compact()
        clock(name)
        counts[name] = len(slots)
    kept = torch.zeros_like(putative.mask[0]).index_fill(0, slots, True)
    return dataclasses.replace(nothing_found, putative=putative, kept=kept, correspondences=c, counts=counts)


def _estimated(
    pipeline: Pipeline, matched: MatchResult, c: Correspondences, scales: list[Tensor], seed: int, clock: Clock
) -> MatchResult:
    """The result with an estimate. c: the matches as pinholes have them, with what is known of the cameras."""
    estimate = pipeline.estimated(c, seed)
    clock("estimation")
    lenses = matched.lenses
    if estimate.lens is not None:
        lenses = photographs.division_lenses(estimate.lens[0], c, scales)
        c = photographs.undistorted_matches(c, lenses, scales).derived(lens=None, shared_lens=None)
    even, F, even_scales = photographs.evenly_reduced(c, estimate.F, scales)
    of_pinholes = estimate.derived(matrix=F, lens=None)
    pair_type = classify(even, of_pinholes, seed=seed)
    clock("pair_type")
    index = np.arange(c.mask.shape[1]).repeat(2).reshape(-1, 2)
    (geometry,) = photographs.pair_geometries([index], even, of_pinholes, pair_type)
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
