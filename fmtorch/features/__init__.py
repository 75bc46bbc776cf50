"""Image -> Features."""

from fmtorch.features.sift import FRAME_SIGMAS, SIFT, keypoints_to_lafs, root_sift

__all__ = ["FRAME_SIGMAS", "SIFT", "keypoints_to_lafs", "root_sift"]
