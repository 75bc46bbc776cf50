"""Image -> Features."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.features.frames import (
        FRAME_SIGMAS,
        DominantGradient,
        NetworkOrientation,
        NetworkShape,
        dominant_gradient,
        frame_scale,
        make_upright,
        rotate_frames,
        upright_frames,
    )
    from fmtorch.features.hessian import HessianDetector
    from fmtorch.features.kornia_features import ALIKED, DISK
    from fmtorch.features.local_feature import LocalFeature, NetworkDescriptor, local_feature
    from fmtorch.features.onnx_network import PatchNetwork
    from fmtorch.features.patches import ImagePyramid
    from fmtorch.features.sift import (
        ASIFT,
        SIFT,
        PatchSIFT,
        RootSIFTPCA,
        VLFeatSIFT,
        keypoints_to_lafs,
        learn_projection,
        project,
        root_sift,
        sift_of_patches,
        simulate_view,
        simulated_views,
    )

__all__ = [
    "ALIKED", "ASIFT", "DISK", "FRAME_SIGMAS", "SIFT", "DominantGradient", "HessianDetector", "ImagePyramid",
    "LocalFeature", "NetworkDescriptor", "NetworkOrientation", "NetworkShape", "PatchNetwork", "PatchSIFT",
    "RootSIFTPCA", "VLFeatSIFT", "dominant_gradient", "frame_scale", "keypoints_to_lafs", "learn_projection",
    "local_feature", "make_upright", "project", "root_sift", "rotate_frames", "sift_of_patches", "simulate_view",
    "simulated_views", "upright_frames",
]  # fmt: skip

lazy_exports(__name__)
