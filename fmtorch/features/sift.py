"""Difference-of-Gaussians keypoints with SIFT descriptors, through OpenCV."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Annotated, Any

import cv2
import kornia
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from fmtorch.core import Features, Within, lazy
from fmtorch.features.describe import root_sift
from fmtorch.features.patches import FRAME_SIGMAS, Image


@dataclasses.dataclass(frozen=True)
class SIFT:
    """Detects DoG keypoints and describes them by SIFT (Lowe, IJCV 2004); an instance may be used by several threads.
    max_features: the strongest that are kept; a location with several orientations counts once for each.
    contrast_threshold, edge_threshold, sigma: as OpenCV's, see ``conf/features/sift.yaml``.
    precise_upscale: double the image so that pixel x lands on 2x, without the quarter-pixel shift of plain resizing.
    max_pixels: a larger image is reduced to so many pixels first, as OpenCV needs about 240 bytes a pixel.
    root: RootSIFT, the square root of the L1-normalised descriptor (Arandjelovic and Zisserman, CVPR 2012)."""

    max_features: Annotated[int, Within(1)] = 8000
    contrast_threshold: float = 0.04
    edge_threshold: float = 10.0
    sigma: float = 1.6
    precise_upscale: bool = True
    max_pixels: int = 16_000_000
    root: bool = False

    def __call__(self, image: Image) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image; none, with N = 0, where nothing is found.
        lafs: half side `FRAME_SIGMAS` sigma, kornia's angle (minus OpenCV's). scores: contrast. descriptors: (N, 128)
        float32, whole numbers 0 to 255 unless `root`. Raises ValueError for another type, shape or an empty image."""
        grey = as_grey(image)
        seen = self._reduced(grey)
        keypoints, computed = self._opencv().detectAndCompute(seen, None)
        descriptors = np.zeros((0, 128), np.float32) if computed is None else computed
        lafs, scores, kept = self._kept(keypoints, seen.shape, grey.shape)
        features = torch.from_numpy(descriptors[kept])
        size = torch.tensor(grey.shape, dtype=torch.int64)
        return Features(lafs, scores, root_sift(features) if self.root else features, size)

    def detect(self, image: Image) -> tuple[Float[torch.Tensor, "n 2 3"], Float[torch.Tensor, " n"]]:
        """The frames and scores of the features that a call finds, without their descriptors."""
        grey = as_grey(image)
        seen = self._reduced(grey)
        lafs, scores, _ = self._kept(self._opencv().detect(seen), seen.shape, grey.shape)
        return lafs, scores

    def _opencv(self) -> cv2.SIFT:
        thresholds, upscale = (self.contrast_threshold, self.edge_threshold), self.precise_upscale
        return cv2.SIFT.create(self.max_features, 3, *thresholds, self.sigma, enable_precise_upscale=upscale)

    def _reduced(self, grey: Image) -> Image:
        factor = math.sqrt(self.max_pixels / grey.size)
        if factor >= 1:
            return grey
        h, w = (max(int(side * factor), 1) for side in grey.shape)
        return cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]

    def _kept(
        self, keypoints: Sequence[cv2.KeyPoint], seen: tuple[int, ...], shape: tuple[int, ...]
    ) -> tuple[torch.Tensor, torch.Tensor, NDArray[np.int64]]:
        """The frames and scores of the strongest keypoints, and which these are; from the image seen to the image."""
        scores = np.array([k.response for k in keypoints], np.float32)
        kept = strongest(scores, self.max_features)
        lafs = keypoints_to_lafs([keypoints[i] for i in kept])
        if seen != shape:
            factor = torch.tensor([shape[1] / seen[1], shape[0] / seen[0]])
            half = torch.tensor([0.0, 0.0, 0.5])  # a pixel's centre is half a pixel from the image's corner
            lafs = (lafs + half) * factor[:, None] - half
        return lafs, torch.from_numpy(scores[kept]), kept


def keypoints_to_lafs(keypoints: Sequence[cv2.KeyPoint]) -> Float[torch.Tensor, "n 2 3"]:
    """OpenCV's keypoints as local affine frames.
    The half side is `FRAME_SIGMAS` times half of `size`, which is a diameter; kornia's angle is minus OpenCV's."""
    table = np.array([(*k.pt, k.size, k.angle) for k in keypoints], np.float32).reshape(-1, 4)
    xy, size, angle = torch.tensor_split(torch.from_numpy(table), (2, 3), dim=1)
    if len(table) == 0:
        return torch.zeros(0, 2, 3)
    half_side = FRAME_SIGMAS * size / 2
    return kornia.feature.laf_from_center_scale_ori(xy[None], half_side[None, :, :, None], -angle[None])[0]


def strongest(scores: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Indices, in order, of the `count` highest scores: OpenCV keeps more where the last ones tie."""
    return np.sort(np.argsort(-scores, kind="stable")[:count])


def as_grey(image: Image) -> Image:
    """A grey image of a grey or RGB one. Raises ValueError for another type, shape or an empty image."""
    if image.dtype != np.uint8 or image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"image is {image.dtype} {image.shape}; it must be a non-empty uint8 (H, W) or RGB (H, W, 3)")
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)  # type: ignore[return-value]


ORIENTATIONS = 4  # of one location at most, as VLFeat
SMALLEST = 16  # px, the shorter side: the smallest octave has 8, and VLFeat takes no smaller image


@dataclasses.dataclass(frozen=True)
class VLFeatSIFT:
    """Detects DoG keypoints and describes them by SIFT as VLFeat does; an instance may be used by several threads.

    The paper (Bian et al., BMVC 2019) took its keypoints and descriptors from there. VLFeat does not double the image
    and, by default, has no threshold of contrast, so that it finds more keypoints than OpenCV, of larger scales.

    max_features: the keypoints of the largest scales that are kept. first_octave: -1 doubles the image first.
    peak_threshold: least contrast |DoG|, for intensities in [0, 1]; 0 takes every extremum. edge_threshold: largest
    ratio of principal curvatures. root: RootSIFT instead."""

    max_features: Annotated[int, Within(1)] = 20000
    first_octave: int = 0
    peak_threshold: float = 0.0
    edge_threshold: float = 10.0
    root: bool = False

    def __post_init__(self) -> None:
        _library()

    def __call__(self, image: Image) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image, as of `SIFT` but for angles and scores.
        scores: sigma in pixels, as VLFeat tells no contrast. Raises ValueError as `SIFT` does."""
        grey = as_grey(image)
        size = torch.tensor(grey.shape, dtype=torch.int64)
        if min(grey.shape) < SMALLEST:
            return Features(torch.zeros(0, 2, 3), torch.zeros(0), torch.zeros(0, 128), size)
        keypoints, computed = self._extractor(grey.shape).extract_from_uint8_array(grey)
        table = [(k.a11, k.a12, k.x, k.a21, k.a22, k.y) for k in keypoints]
        frames = torch.tensor(table, dtype=torch.float32).reshape(-1, 2, 3)
        sigma = frames[:, :, 0].norm(dim=1)
        order = torch.argsort(-sigma, stable=True)[: self.max_features].sort().values
        lafs = torch.cat([FRAME_SIGMAS * frames[..., :2], frames[..., 2:] - 0.5], -1)  # COLMAP's origin is the corner
        descriptors = torch.from_numpy(np.array(computed.data, np.float32).reshape(-1, 128))[order]
        return Features(lafs[order], sigma[order], root_sift(descriptors) if self.root else descriptors, size)

    def _extractor(self, shape: tuple[int, ...]) -> Any:
        pycolmap = _library()
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu, options.num_threads = False, 1
        sift = options.sift
        sift.first_octave, sift.num_octaves = self.first_octave, octaves(shape, self.first_octave)
        sift.peak_threshold = max(self.peak_threshold, 1e-12)  # pycolmap refuses zero
        sift.edge_threshold = self.edge_threshold
        sift.max_num_orientations = ORIENTATIONS
        sift.max_num_features = max(self.max_features, 1)
        sift.normalization = pycolmap.Normalization.L2
        return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def octaves(shape: tuple[int, ...], first: int) -> int:
    """How many octaves VLFeat takes of an image (h, w): as many as leave 8 px of the shorter side."""
    return max(int(math.log2(min(shape))) - first - 3, 1)


def _library() -> Any:
    """pycolmap, which says nothing but warnings. Raises ImportError naming the extra where it is not installed."""
    pycolmap = lazy.imported("pycolmap", "features=sift_vlfeat needs pycolmap: pip install 'fmtorch[colmap]'")
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    return pycolmap


ROTATION_STEP = 72.0  # degrees, divided by the tilt; section 5.2 of the paper
ANTIALIAS_SIGMA = 0.8  # times sqrt(t^2 - 1), the blur along the axis that is then reduced t times; section 5.1


@dataclasses.dataclass(frozen=True)
class ASIFT(SIFT):
    """SIFT on simulated views of an image, the keypoints mapped back; an instance may be used by several threads.

    A view is the image rotated by an angle, then reduced t times along x: as a camera would see a distant plane from
    latitude arccos(1 / t). The tilts are ``t = sqrt(2)^k``, k = 0 ... tilts - 1, at the angles 0, 72 / t, ... below
    180 degrees: 43 views for the paper's six tilts, about 14 times the area of the image. No tilt is plain SIFT.

    max_features: the strongest kept over all views. The other options are those of `SIFT` in each view."""

    max_features: Annotated[int, Within(1)] = 30000
    tilts: int = 6

    def __call__(self, image: Image) -> Features:
        """The features of an image, and what is raised for another, as of `SIFT`.
        lafs: the frames of the views in the image, full affine. scores, descriptors: as found in the views. Frames that
        leave the image are dropped, except in the view that is the image."""
        grey = as_grey(image)
        parts = [super().__call__(grey)]
        for tilt, angle in simulated_views(self.tilts)[1:]:
            view, to_view = simulate_view(grey, tilt, angle)
            parts.append(_mapped_back(super().__call__(view), to_view, grey.shape))
        scores = torch.cat([f.scores for f in parts])
        kept = torch.from_numpy(strongest(scores.numpy(), self.max_features))
        lafs, descriptors = (torch.cat([getattr(f, name) for f in parts])[kept] for name in ("lafs", "descriptors"))
        return Features(lafs, scores[kept], descriptors, parts[0].image_size)


def simulated_views(tilts: int) -> list[tuple[float, float]]:
    """(tilt, angle in degrees) of the views, the image itself, (1, 0), first. Raises ValueError for no tilts."""
    if tilts < 1:
        raise ValueError(f"tilts is {tilts}; there must be at least one, which is the image itself")
    views = [(1.0, 0.0)]
    for k in range(1, tilts):
        tilt = math.sqrt(2) ** k
        views += [(tilt, i * ROTATION_STEP / tilt) for i in range(math.ceil(180 * tilt / ROTATION_STEP - 1e-9))]
    return views


def simulate_view(grey: Image, tilt: float, angle: float) -> tuple[Image, np.ndarray]:
    """The view of a grey image rotated by `angle` degrees and reduced `tilt` times along x, and the map to it (2, 3).
    The border of the image is continued where the view shows more. Blurred before it is reduced."""
    h, w = grey.shape
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    corners = rotation @ np.array([[0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1]])
    low, high = corners.min(1), corners.max(1)
    width, height = (math.ceil(extent - 1e-6) + 1 for extent in high - low)
    rotate = np.concatenate([rotation, -low[:, None]], 1)
    turned = cv2.warpAffine(grey, rotate, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    blurred = cv2.GaussianBlur(turned, (0, 0), sigmaX=ANTIALIAS_SIGMA * math.sqrt(tilt**2 - 1), sigmaY=0.01)
    reduce = np.array([[1 / tilt, 0, 0], [0, 1, 0]])
    narrow = math.floor((width - 1) / tilt) + 1
    view = cv2.warpAffine(blurred, reduce, (narrow, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return view.astype(np.uint8, copy=False), reduce[:, :2] @ rotate


def _mapped_back(features: Features, to_view: np.ndarray, shape: tuple[int, ...]) -> Features:
    """The features of a view in the image's coordinates, without those whose frame leaves the image."""
    to_image = torch.from_numpy(np.linalg.inv(to_view[:, :2]))
    lafs = features.lafs.double()
    centre = (lafs[..., 2] - torch.from_numpy(to_view[:, 2])) @ to_image.T
    half_side = torch.linalg.vector_norm(lafs[..., 0], dim=-1)
    # A circle of the view reaches |row of the map| times its radius in the image.
    reach = half_side[:, None] * torch.linalg.vector_norm(to_image, dim=1)
    far = torch.tensor([shape[1] - 1, shape[0] - 1], dtype=centre.dtype)
    kept = ((centre >= reach) & (centre <= far - reach)).all(-1)
    return features.replace(lafs=torch.cat([to_image @ lafs[..., :2], centre[..., None]], -1).float())[kept]
