"""Features x Features -> Correspondences."""

from fmtorch.core.checks import public
from fmtorch.matching.matcher import NearestNeighborMatcher
from fmtorch.matching.nearest import Neighbors
from fmtorch.matching.nearest import nearest_neighbors as _nearest_neighbors

_public = public(__name__)
nearest_neighbors = _public(_nearest_neighbors)

__all__ = [
    "NearestNeighborMatcher",
    "Neighbors",
    "nearest_neighbors",
]
