"""VLFeat's difference-of-Gaussians keypoints with SIFT descriptors, through pycolmap (extra `colmap`)."""

from __future__ import annotations

import dataclasses
import math
from types import ModuleType
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.options import Within
from fmtorch.core.types import Features
from fmtorch.features.frames import FRAME_SIGMAS
from fmtorch.features.sift import as_grey, root_sift

ORIENTATIONS = 4  # of one location at most, as VLFeat
SMALLEST = 16  # px, the shorter side: the smallest octave has 8, and VLFeat takes no smaller image


@dataclasses.dataclass(frozen=True)
class VLFeatSIFT:
    """Detects DoG keypoints and describes them by SIFT as VLFeat does; an instance may be used by several threads.

    The paper (Bian et al., BMVC 2019) took its keypoints and descriptors from there. VLFeat does not double the image
    and, by default, has no threshold of contrast, so that it finds more keypoints than OpenCV, of larger scales.

    max_features: the keypoints of the largest scales that are kept.
    first_octave: -1 doubles the image first.
    peak_threshold: least contrast |DoG|, for intensities in [0, 1]; 0 takes every extremum.
    edge_threshold: largest ratio of principal curvatures.
    root: RootSIFT instead.
    """

    max_features: Annotated[int, Within(1)] = 20000
    first_octave: int = 0
    peak_threshold: float = 0.0
    edge_threshold: float = 10.0
    root: bool = False

    def __post_init__(self) -> None:
        _library()

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image; none, with N = 0, where nothing is found.

        lafs: half side `FRAME_SIGMAS` sigma. scores: sigma in pixels, as VLFeat tells no contrast. descriptors:
        (N, 128) float32, whole numbers from 0 to 255 unless `root`. Raises ValueError for another type, shape or an
        empty image.
        """
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


def _library() -> ModuleType:
    """pycolmap, which says nothing but warnings. Raises ImportError naming the extra where it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError("features=sift_vlfeat needs pycolmap: pip install 'fmtorch[colmap]'") from error
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    module: ModuleType = pycolmap
    return module
