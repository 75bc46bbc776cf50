"""From outcomes to figures: rows of metrics, summaries with intervals, recall curves, and the loop that makes a run."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.evaluation.curves import MAX_THUMBNAILS, picture, svg, view_graph_svg
    from fmtorch.evaluation.report import Section, ShownPair, differing_pairs, render, run_names
    from fmtorch.evaluation.run import evaluate, evaluate_pairs, focal_errors, informed, run_identity
    from fmtorch.evaluation.statistics import common_reasons, summarize
    from fmtorch.evaluation.tables import summary_markdown, terminal_tables

__all__ = [
    "MAX_THUMBNAILS", "Section", "ShownPair", "common_reasons", "differing_pairs", "evaluate", "evaluate_pairs",
    "focal_errors", "informed", "picture", "render", "run_identity", "run_names", "summarize", "summary_markdown",
    "svg", "terminal_tables", "view_graph_svg",
]  # fmt: skip

lazy_exports(__name__)
