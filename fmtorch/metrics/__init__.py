"""Figures of merit for fundamental matrices and matches, as plain batched functions of tensors or NumPy arrays.

Their results are tensors; sizes may also be tuples (h, w).
`fmtorch.metrics.torchmetrics` has thin classes over them that accumulate over batches and processes."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.metrics.nsgd import nsgd, nsgd_released, sgd
    from fmtorch.metrics.pose import PoseError, closest_pose_error, corner_error, fundamental_pose_error, pose_error
    from fmtorch.metrics.recall import (
        InlierRate,
        ground_truth_inliers,
        inlier_rate,
        mean_recall,
        pose_auc,
        pose_maa,
        pose_map,
        recall,
        right_of_homography,
    )

__all__ = [
    "InlierRate", "PoseError", "closest_pose_error", "corner_error", "fundamental_pose_error", "ground_truth_inliers",
    "inlier_rate", "mean_recall", "nsgd", "nsgd_released", "pose_auc", "pose_error", "pose_maa", "pose_map", "recall",
    "right_of_homography", "sgd",
]  # fmt: skip

lazy_exports(__name__)
