"""Features x Features -> Correspondences."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.matching.matcher import NearestNeighborMatcher
    from fmtorch.matching.nearest import Neighbors, nearest_neighbors

__all__ = [
    "NearestNeighborMatcher", "Neighbors", "nearest_neighbors",
]  # fmt: skip

lazy_exports(__name__, checked=True)
