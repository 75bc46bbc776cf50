"""The four stages in a row, for data sets, two photographs, a folder of them, and matches alone."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.pipeline.folder import FolderMatches, chosen_pairs, folder_workers, images_below, match_records
    from fmtorch.pipeline.photographs import PhotographCameras
    from fmtorch.pipeline.pipeline import Memo, Outcome, Pipeline, build_pipeline, examined, load_pipeline
    from fmtorch.pipeline.two_images import Described, MatchResult, describe, match

__all__ = [
    "Described", "FolderMatches", "MatchResult", "Memo", "Outcome", "PhotographCameras", "Pipeline",
    "build_pipeline", "chosen_pairs", "describe", "examined", "folder_workers", "images_below", "load_pipeline",
    "match", "match_records",
]  # fmt: skip

lazy_exports(__name__)
