"""Others' files: matches that other programs computed, read as data sets (docs/exchange.md)."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.io.colmap import EXIF_DEVIATION, MatchDatabase, database_image, write_database
    from fmtorch.io.dataset import H5Pairs
    from fmtorch.io.export import DATABASE, Edge, ViewGraph, export_kinds, view_graph, write_exports, write_view_graph
    from fmtorch.io.match_store import ORIGIN, MatchStore, StoredImage, StoredPair, indices

__all__ = [
    "DATABASE", "EXIF_DEVIATION", "ORIGIN", "Edge", "H5Pairs", "MatchDatabase", "MatchStore",
    "StoredImage", "StoredPair", "ViewGraph", "database_image", "export_kinds", "indices", "view_graph",
    "write_database", "write_exports", "write_view_graph",
]  # fmt: skip

lazy_exports(__name__)
