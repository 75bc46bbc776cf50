"""Features x Features -> Correspondences."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.matching.lightglue import LightGlue
    from fmtorch.matching.nearest import NearestNeighborMatcher, Neighbors, nearest_neighbors
    from fmtorch.matching.vismatch import VisMatch

__all__ = [
    "LightGlue", "NearestNeighborMatcher", "Neighbors", "VisMatch", "nearest_neighbors",
]  # fmt: skip

lazy_exports(__name__, checked=True)
