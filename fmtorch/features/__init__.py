"""Image -> Features."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.features.affine_shape import NetworkShape
    from fmtorch.features.asift import ASIFT, simulate_view, simulated_views
    from fmtorch.features.compose import local_feature
    from fmtorch.features.frames import FRAME_SIGMAS, frame_scale, make_upright, rotate_frames, upright_frames
    from fmtorch.features.hessian import HessianDetector
    from fmtorch.features.local_feature import LocalFeature, NetworkDescriptor
    from fmtorch.features.orientation import DominantGradient, NetworkOrientation, dominant_gradient
    from fmtorch.features.patch_sift import PatchSIFT, sift_of_patches
    from fmtorch.features.patches import ImagePyramid
    from fmtorch.features.rootsift_pca import RootSIFTPCA, learn_projection
    from fmtorch.features.sift import SIFT, keypoints_to_lafs, root_sift
    from fmtorch.features.vlfeat_sift import VLFeatSIFT

__all__ = [
    "ASIFT",
    "FRAME_SIGMAS",
    "SIFT",
    "DominantGradient",
    "HessianDetector",
    "ImagePyramid",
    "LocalFeature",
    "NetworkDescriptor",
    "NetworkOrientation",
    "NetworkShape",
    "PatchSIFT",
    "RootSIFTPCA",
    "VLFeatSIFT",
    "dominant_gradient",
    "frame_scale",
    "keypoints_to_lafs",
    "learn_projection",
    "local_feature",
    "make_upright",
    "root_sift",
    "rotate_frames",
    "sift_of_patches",
    "simulate_view",
    "simulated_views",
    "upright_frames",
]

lazy_exports(__name__)
