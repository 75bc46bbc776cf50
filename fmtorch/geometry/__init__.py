"""Two-view projective geometry as pure, batched, differentiable functions."""

from fmtorch.geometry.eight_point import eight_point
from fmtorch.geometry.normalize import denormalize_fundamental, normalize_pair, normalize_points, unit_frobenius
from fmtorch.geometry.pose import Pose, pose_from_fundamental
from fmtorch.geometry.rank2 import nearest_rank2
from fmtorch.geometry.seven_point import seven_point

__all__ = [
    "Pose",
    "denormalize_fundamental",
    "eight_point",
    "nearest_rank2",
    "normalize_pair",
    "normalize_points",
    "pose_from_fundamental",
    "seven_point",
    "unit_frobenius",
]
