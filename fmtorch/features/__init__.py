"""Image -> Features."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.features.describe import PatchSIFT, RootSIFTPCA, learn_projection, project, root_sift, sift_of_patches
    from fmtorch.features.frames import DominantGradient, NetworkOrientation, NetworkShape, dominant_gradient
    from fmtorch.features.hessian import HessianDetector, upright_frames
    from fmtorch.features.kornia_features import ALIKED, DISK, XFeat
    from fmtorch.features.local_feature import LocalFeature, NetworkDescriptor, PatchNetwork, local_feature
    from fmtorch.features.patches import FRAME_SIGMAS, ImagePyramid, frame_scale, make_upright, rotate_frames
    from fmtorch.features.sift import ASIFT, SIFT, VLFeatSIFT, keypoints_to_lafs, simulate_view, simulated_views

__all__ = [
    "ALIKED", "ASIFT", "DISK", "FRAME_SIGMAS", "SIFT", "DominantGradient", "HessianDetector", "ImagePyramid",
    "LocalFeature", "NetworkDescriptor", "NetworkOrientation", "NetworkShape", "PatchNetwork", "PatchSIFT",
    "RootSIFTPCA", "VLFeatSIFT", "XFeat", "dominant_gradient", "frame_scale", "keypoints_to_lafs", "learn_projection",
    "local_feature", "make_upright", "project", "root_sift", "rotate_frames", "sift_of_patches", "simulate_view",
    "simulated_views", "upright_frames",
]  # fmt: skip

lazy_exports(__name__)
