"""From outcomes to figures: rows of metrics, summaries with intervals, recall curves, and the loop that makes a run."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.evaluation.rows import evaluate, focal_errors
    from fmtorch.evaluation.run import WithPairCameras, built_with, cameras_of, evaluate_pairs, run_identity
    from fmtorch.evaluation.statistics import common_reasons, summarize
    from fmtorch.evaluation.tables import summary_markdown, terminal_tables

__all__ = [
    "WithPairCameras", "built_with", "cameras_of", "common_reasons", "evaluate", "evaluate_pairs", "focal_errors",
    "run_identity", "summarize", "summary_markdown", "terminal_tables",
]  # fmt: skip

lazy_exports(__name__)
