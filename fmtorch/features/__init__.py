"""Image -> Features."""

from fmtorch.features.asift import ASIFT, simulate_view, simulated_views
from fmtorch.features.sift import FRAME_SIGMAS, SIFT, keypoints_to_lafs, root_sift

__all__ = ["ASIFT", "FRAME_SIGMAS", "SIFT", "keypoints_to_lafs", "root_sift", "simulate_view", "simulated_views"]
