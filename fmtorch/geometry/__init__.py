"""Two-view projective geometry as pure, batched, differentiable functions."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.geometry.cameras import cross_matrix, fundamental_from_calibration, fundamental_from_projections
    from fmtorch.geometry.covariance import TwoViewCovariance, two_view_covariance
    from fmtorch.geometry.eight_point import eight_point
    from fmtorch.geometry.epipolar import (
        algebraic,
        epipolar_distances,
        epipolar_lines,
        point_to_line,
        sampson,
        sampson_squared,
        symmetric_max,
        symmetric_mean,
        symmetric_squared,
        unit_frobenius,
    )
    from fmtorch.geometry.homography import homography, homography_points, homography_sampson, homography_transfer
    from fmtorch.geometry.homography_pose import PlanePoses, poses_from_homography
    from fmtorch.geometry.homography_refine import refine_homography
    from fmtorch.geometry.levenberg_marquardt import LOSSES
    from fmtorch.geometry.matrices import nearest_rank2
    from fmtorch.geometry.normalize import canonical, denormalize_fundamental, normalize_points
    from fmtorch.geometry.pose import FourPoses, Pose, pose_from_fundamental, poses_from_fundamental
    from fmtorch.geometry.refine import Fits, attached_step, irls, refine, reweighted_fits
    from fmtorch.geometry.seven_point import seven_point
    from fmtorch.geometry.significance import significance

__all__ = [
    "LOSSES", "Fits", "FourPoses", "PlanePoses", "Pose", "TwoViewCovariance", "algebraic", "attached_step",
    "canonical", "cross_matrix", "denormalize_fundamental", "eight_point", "epipolar_distances", "epipolar_lines",
    "fundamental_from_calibration", "fundamental_from_projections", "homography", "homography_points",
    "homography_sampson", "homography_transfer", "irls", "nearest_rank2", "normalize_points",
    "point_to_line", "pose_from_fundamental", "poses_from_fundamental", "poses_from_homography", "refine",
    "refine_homography", "reweighted_fits", "sampson", "sampson_squared", "seven_point",
    "significance", "symmetric_max", "symmetric_mean", "symmetric_squared", "two_view_covariance", "unit_frobenius",
]  # fmt: skip

lazy_exports(__name__, checked=True)
