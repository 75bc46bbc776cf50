"""Photographs for a pipeline: what is known of their cameras, their reduction, and their geometries for COLMAP."""

import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
import PIL.Image
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from fmtorch.core.lenses import division_lens
from fmtorch.core.types import Correspondences, Estimate
from fmtorch.data import ImageCameras, ImageSource, Lens, exif_focal, read_image
from fmtorch.data.image_cameras import pinhole
from fmtorch.geometry.cameras import calibration_problems
from fmtorch.geometry.epipolar import unit_frobenius
from fmtorch.geometry.pair_type import GENERAL, IDENTICAL, PLANAR, ROTATION
from fmtorch.io.match_store import Kind, PairGeometry
from fmtorch.runs.fingerprint import file_digest
from fmtorch.two_view import lenses as two_view
from fmtorch.two_view.arguments import camera_fields
from fmtorch.two_view.pair_type import FOCAL_DEVIATION, PairTypes, warnings_of

WORDS = ("unknown", "shared", "exif")


class PhotographCamera(NamedTuple):
    """What is known of the camera of one photograph.
    lens: with distortion. focal: px, and its relative deviation, if that alone is known. note: what is said of it."""

    lens: Lens | None = None
    focal: tuple[float, float] | None = None
    note: str = ""


class PhotographCameras:
    """The cameras of photographs.
    cameras: one of `WORDS`, a file of cameras (`ImageCameras`), or None where nothing is asked of them. K: fx, fy, cx,
    cy of all, px, as numbers or as a text, or None. Raises ValueError where both are given, or for what no camera is,
    and DataError for a file that is damaged or holds something else."""

    def __init__(self, cameras: Path | None = None, K: str | Sequence[float | int] | None = None) -> None:
        if K is not None and cameras is not None:
            raise ValueError("cameras and K are given; give one of them")
        self.word = str(cameras) if cameras is not None and str(cameras) in WORDS else None
        self._of_all = None if K is None else _pinhole(K)
        self._file: Path | None = None
        self._stored: ImageCameras | None = None
        self.of = functools.cache(self._of)
        if cameras is not None and self.word is None:
            if not cameras.exists():
                known_words = f"it must be {', '.join(WORDS)}, a COLMAP model or a JSON file"
                raise ValueError(f"cameras={cameras}: no such file; {known_words}. One calibration is K=fx,fy,cx,cy")
            self._file, self._stored = cameras, ImageCameras(cameras)

    @property
    def identity(self) -> dict[str, Any]:
        """What results depend on, as plain values; empty where nothing is asked of cameras."""
        if self._file is not None:
            files = sorted(self._file.iterdir()) if self._file.is_dir() else [self._file]
            return {"cameras": {"files": [file_digest(path) for path in files if path.is_file()]}}
        if (lens := self._of_all) is not None:
            return {"cameras": {"K": [lens.fx, lens.fy, lens.cx, lens.cy]}}
        return {} if self.word is None else {"cameras": self.word}

    def source(self, path: Path) -> ImageSource:
        """A photograph for `read_image`, which raises ImageError for one that is not of its camera's size."""
        return ImageSource(path.name, path, None if self._stored is None else self._stored.of(path).size)

    def _of(self, path: Path, size: tuple[int, int]) -> PhotographCamera:
        if self._of_all is not None:
            return PhotographCamera(self._of_all)
        if self._stored is not None:
            lens = self._stored.of(path).lens
            if lens is None or not lens.bends:
                return PhotographCamera(lens)
            what = f"{path.name}: F and the pose are of the image without the distortion of its {lens.model} lens"
            return PhotographCamera(lens, note=f"{what}; points are where they are in the photograph")
        if self.word == "exif":
            exif = exif_focal(path, size)
            if exif.known:
                return PhotographCamera(focal=(exif.focal, exif.deviation))
            return PhotographCamera(note=f"{path.name}: focal length not known: {exif.source}")
        return PhotographCamera()

    def knowledge(self, camera0: PhotographCamera, camera1: PhotographCamera) -> dict[str, Any]:
        """K0, K1, focal and lens of a pair, as `fmtorch.match` takes them."""
        if self.word in ("unknown", "shared"):
            return {"focal": self.word}
        if self.word == "exif":
            measured = [camera0.focal, camera1.focal]
            return {"focal": "unknown" if measured == [None, None] else measured}
        if self._of_all is None and self._stored is None:
            return {}
        both = camera0.lens, camera1.lens
        known: dict[str, Any] = {f"K{i}": None if lens is None or lens.bends else lens.K for i, lens in enumerate(both)}
        if any(lens is not None and lens.bends for lens in both):
            known["lens"] = tuple(lens if lens is not None and lens.bends else None for lens in both)
        if both == (None, None):
            known["focal"] = "unknown"
        return known

    def given(self, paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> dict[str, Any]:
        """What `relate` takes of a pair's cameras."""
        known = self.knowledge(*(self.of(path, size) for path, size in zip(paths, sizes, strict=True)))
        lenses = known.get("lens", (None, None))
        K0, K1 = (known.get(f"K{i}") if lens is None else lens.K for i, lens in enumerate(lenses))
        return {"cameras": camera_fields(K0, K1, known.get("focal"), sizes_known=True), "lenses": lenses}


def _pinhole(K: str | Sequence[float | int]) -> Lens:
    words = K.replace(",", " ").replace("[", " ").replace("]", " ").split() if isinstance(K, str) else K
    try:
        return pinhole([float(word) for word in words], "K")
    except ValueError as error:
        raise ValueError(f"K={K}; it must be fx,fy,cx,cy in pixels, with positive focal lengths") from error


Image = NDArray[np.uint8]
GivenImage = Path | str | Image | Any  # or one of Pillow's, which is imported by who has one
Array = NDArray[np.float64]


def given_image(image: GivenImage, name: str) -> Image:
    """The pixels of a file, turned as its EXIF orientation says, of Pillow's image, or of an array.
    Raises ImageError for a file that is no sound image, TypeError or ValueError, naming it, for what is no image."""
    if isinstance(image, Path | str):
        return read_image(image, orient=True)
    if isinstance(image, PIL.Image.Image):
        grey = image.mode in ("1", "L", "LA")
        if not grey and image.mode not in ("RGB", "RGBA", "P", "CMYK", "YCbCr", "HSV", "LAB"):
            raise ValueError(f"{name} is a Pillow image of mode {image.mode}; it must be of 8 bits: L or RGB")
        return np.asarray(image.convert("L" if grey else "RGB"))
    if not isinstance(image, np.ndarray):
        kind = type(image).__name__
        raise TypeError(f"{name} is a {kind}; it must be a file's path, a Pillow image or a uint8 array of NumPy")
    colour = image.ndim == 3 and image.shape[2] == 3
    if image.dtype != np.uint8 or image.size == 0 or not (image.ndim == 2 or colour):
        raise ValueError(f"{name} is {image.dtype} {image.shape}; it must be non-empty uint8, (H, W) or RGB (H, W, 3)")
    return image


def reduced_image(image: Image, longest_side: int) -> tuple[Image, Float[Tensor, " xy"]]:
    """The image with its longest side at most that long, and its scale in x and y (rounding makes them differ)."""
    h, w = image.shape[:2]
    scale = min(1.0, longest_side / max(h, w))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    if size != (w, h):
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image, torch.tensor([size[0] / w, size[1] / h], dtype=torch.float64)


def to_original(x: Tensor, s: Tensor) -> Tensor:
    """Points of a reduced image in pixels of the original; exactly x where nothing was reduced."""
    return x / s + (1 - s) / (2 * s)


def frames_to_original(lafs: Float[Tensor, "*batch 2 3"] | None, s: Tensor) -> Float[Tensor, "*batch 2 3"] | None:
    """Local affine frames of a reduced image in pixels of the original."""
    if lafs is None:
        return None
    return torch.cat([lafs[..., :2] / s[:, None], to_original(lafs[..., 2:].mT, s).mT], -1)


def reduced_cameras(
    fields: Mapping[str, Tensor], scales: Sequence[Tensor], sizes: Sequence[tuple[int, int]]
) -> dict[str, Tensor]:
    """What is known of the cameras of two images as they were reduced, of a batch of one.
    fields: of `camera_fields`, for the originals. scales: of both images in x and y. sizes: (h, w) of the originals.
    Raises ValueError, naming it, for a K that is none of its image, and for a focal of several pairs."""
    if "focal" in fields and fields["focal"].shape != (2, 2):
        raise ValueError(f"focal has shape {tuple(fields['focal'].shape)}; it must be of one pair of images")
    reduced = {name: value[None].clone() for name, value in fields.items()}
    for i, (s, size) in enumerate(zip(scales, sizes, strict=True)):
        if f"K{i}" in reduced:
            K = reduced[f"K{i}"].to(torch.float64)
            if K.shape != (1, 3, 3):
                raise ValueError(f"K{i} has shape {tuple(K.shape[1:])}; it must be (3, 3)")
            if problem := calibration_problems(K, torch.tensor([size]), f"K{i}")[0]:
                raise ValueError(problem)
            reduced[f"K{i}"] = _reduction(s) @ K
        if "focal" in reduced:
            reduced["focal"][:, i, 0] *= s.prod().sqrt().item()
    return reduced


def _reduction(s: Tensor) -> Tensor:
    """The map (3, 3) from pixels of the original to those of the reduced image."""
    # (0, 0) is the centre of the first pixel, so x_reduced + 1/2 = s (x + 1/2).
    return torch.tensor([[s[0], 0, (s[0] - 1) / 2], [0, s[1], (s[1] - 1) / 2], [0, 0, 1]], dtype=torch.float64)


def division_lenses(
    bent: Float[Tensor, " images"], c: Correspondences, scales: Sequence[Tensor]
) -> tuple[Lens | None, Lens | None]:
    """Lenses of the originals from estimated lambdas (2,), None of images that are straight or not determined.

    c: a batch of one, of the reduced images, whose K have focal lengths and principal points if they are known."""
    lenses: list[Lens | None] = []
    for value, K, size, scale in zip(bent.tolist(), (c.K0, c.K1), (c.size0, c.size1), scales, strict=True):
        lens = division_lens(value, cast(Tensor, size)[0].tolist())
        if K is not None:
            (fx, _, cx), (_, fy, cy), _ = (K[0] / K[0, 2, 2]).tolist()
            lens = Lens(fx, fy, cx, cy, "DIVISION", (value * fx * fy / lens.fx**2,))
        lenses.append(lens.scaled(*(1 / scale).tolist()) if math.isfinite(value) and value else None)
    return lenses[0], lenses[1]


def undistorted_matches(c: Correspondences, lenses: Sequence[Lens | None], scales: Sequence[Tensor]) -> Correspondences:
    """Matches of two reduced photographs as pinholes of the same K would have them, in pixels of the reduced images.
    lenses: of the originals, None where nothing is distorted. A match that a pinhole does not see is masked."""
    both = zip(lenses, scales, strict=True)
    first, second = (None if lens is None else lens.scaled(*scale.tolist()) for lens, scale in both)
    return two_view.undistorted_matches(c, [(first, second)])


def evenly_reduced(
    c: Correspondences, F: Float[Tensor, "b 3 3"], scales: Sequence[Tensor]
) -> tuple[Correspondences, Float[Tensor, "b 3 3"], list[Tensor]]:
    """Matches, F and scales of images reduced alike in x and y, which whole pixels seldom are.
    A crop of a photograph is otherwise stretched beside it by more than its noise, as no copy is."""
    even = [s.prod().sqrt().expand(2) for s in scales]
    ratios = [(s / each).to(c.x0.device) for s, each in zip(scales, even, strict=True)]
    maps = [_reduction(1 / ratio.cpu()).to(F) for ratio in ratios]
    fields: dict[str, Tensor | None] = {}
    ends = (c.x0, c.lafs0, c.K0), (c.x1, c.lafs1, c.K1)
    for i, ((x, lafs, K), ratio, A) in enumerate(zip(ends, ratios, maps, strict=True)):
        fields[f"x{i}"] = to_original(x.double(), ratio)
        fields[f"lafs{i}"] = frames_to_original(lafs, ratio.to(x))
        fields[f"K{i}"] = None if K is None else A.to(K) @ K
    back0, back1 = (torch.linalg.inv(A) for A in maps)
    return c.derived(**fields), unit_frobenius(back1.T @ F @ back0), even


def geometry_to_original(geometry: PairGeometry, s0: Tensor, s1: Tensor) -> PairGeometry:
    """The geometry of two reduced images in pixels of the originals."""
    A0, A1 = (_reduction(s).numpy() for s in (s0.cpu(), s1.cpu()))
    F = None if geometry.F is None else A1.T @ geometry.F @ A0
    H = None if geometry.H is None else np.linalg.inv(A1) @ geometry.H @ A0
    F, H = (None if matrix is None else matrix / np.linalg.norm(matrix) for matrix in (F, H))
    return geometry._replace(F=F, H=H)


def fundamental_to_original(F: Float[Tensor, "3 3"], s0: Tensor, s1: Tensor) -> Float[Tensor, "3 3"]:
    """F between two reduced images in pixels of the originals, of unit Frobenius norm."""
    A0, A1 = (_reduction(s).to(F) for s in (s0, s1))
    return unit_frobenius(A1.T @ F @ A0)


KINDS: dict[int, Kind] = {PLANAR: "planar", ROTATION: "panoramic", IDENTICAL: "planar_or_panoramic"}
MAX_CONFLICT = 3.0  # deviations, of an estimated focal length from that of a camera that counts as calibrated


def pair_geometries(
    matches: Sequence[NDArray[np.integer[Any]]], c: Correspondences, estimate: Estimate, pair_type: PairTypes
) -> list[PairGeometry]:
    """The geometries of a batch of pairs, whose matches are keypoints (n, 2) of both images.
    Of general pairs F, its inliers, and E and the pose where there is one; of others the homography and its inliers,
    and the pose where the cameras are known or only turn. A pair is calibrated where both focal lengths are known and
    the matches agree; one whose support is not beyond chance is degenerate. c: the same matches, with what the
    estimator was given of their cameras."""
    calibrated = _calibrated(c, estimate)
    said = [*zip(estimate.reason, warnings_of(estimate, pair_type), strict=True)]
    kind, homography = pair_type.kind, pair_type.homography
    kinds = torch.where(kind != GENERAL, kind, torch.where(estimate.related, GENERAL, -1)).tolist()
    results = []
    for i, (index, what) in enumerate(zip(matches, kinds, strict=True)):
        of_lines = what == GENERAL or (what == PLANAR and bool(calibrated[i]))
        inliers = index[(estimate if of_lines else homography).inliers[i, : len(index)].cpu().numpy()]
        H = _known(homography.H[i], homography.ok[i])
        if what == GENERAL:
            results.append(_with_lines("calibrated" if calibrated[i] else "uncalibrated", inliers, estimate, i, H))
        elif of_lines:
            results.append(_with_lines("planar", inliers, estimate, i, H))
        elif what not in KINDS:
            results.append(PairGeometry("degenerate", index[:0]))
        elif what == ROTATION:
            R = pair_type.evidence.R[i].cpu().numpy()
            results.append(PairGeometry("panoramic", inliers, H=H, R=R, t=np.zeros(3)))
        else:
            results.append(PairGeometry(KINDS[what], inliers, H=H))
    return [geometry._replace(reason=why, warning=but) for geometry, (why, but) in zip(results, said, strict=True)]


def _calibrated(c: Correspondences, estimate: Estimate) -> Tensor:
    """Whether both focal lengths of a pair are known, the pose with them, and no estimated one contradicts K: (b,)."""
    if c.focal is None or estimate.R is None:
        return torch.zeros_like(estimate.ok)
    deviation = c.focal[..., 1]
    known = deviation.isfinite().all(1) & estimate.R.isfinite().flatten(1).all(1)
    if c.K0 is None or c.K1 is None or estimate.focals is None:
        return known
    stored = torch.stack([torch.sqrt(K[:, 0, 0] * K[:, 1, 1]) for K in (c.K0, c.K1)], 1)
    conflict = (estimate.focals / stored).log().abs() > MAX_CONFLICT * deviation.clamp_min(FOCAL_DEVIATION)
    return known & ~conflict.any(1)


def _with_lines(kind: Kind, inliers: NDArray[np.integer[Any]], estimate: Estimate, i: int, H: Any) -> PairGeometry:
    pose = estimate.E, estimate.R, estimate.t
    E, R, t = (None if value is None else _known(value[i], value[i].isfinite().all()) for value in pose)
    return PairGeometry(kind, inliers, estimate.F[i].detach().cpu().double().numpy(), E, H, R, t)


def _known(value: Tensor, known: Tensor) -> NDArray[np.float64] | None:
    return value.detach().cpu().double().numpy() if known else None
