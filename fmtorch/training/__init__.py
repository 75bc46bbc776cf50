"""Labelled matches of any data set with ground truth, and the training of learned pruners on them.

The loop needs the extra `train`: `fmtorch.training.run`, run by `fmtorch train`."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.training.export import Use, Validation, export_onnx, reliability, save_weights, temperature
    from fmtorch.training.labelled import Augmentation, LabelledMatches, collate, crop, keep_ratio, move, rotate, swap
    from fmtorch.training.matched_pairs import MatchedPairs, OANetPairs
    from fmtorch.training.objective import Objective, classification_loss, geometric_loss, nsgd_loss, virtual_points
    from fmtorch.training.options import PlaneViews
    from fmtorch.training.planes import Photograph, PlanePairs, list_photographs, plane_homography, random_camera
    from fmtorch.training.stored_matches import Draw, SimilarLengthBatches, StoredMatches, collate_trimmed, split_scenes

__all__ = [
    "Augmentation", "Draw", "LabelledMatches", "MatchedPairs", "OANetPairs", "Objective", "Photograph", "PlanePairs",
    "PlaneViews", "SimilarLengthBatches", "StoredMatches", "Use", "Validation", "classification_loss", "collate",
    "collate_trimmed", "crop", "export_onnx", "geometric_loss", "keep_ratio", "list_photographs", "move", "nsgd_loss",
    "plane_homography", "random_camera", "reliability", "rotate", "save_weights", "split_scenes", "swap", "temperature",
    "virtual_points",
]  # fmt: skip

lazy_exports(__name__)
