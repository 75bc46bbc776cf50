"""Features x Features -> Correspondences."""

from fmtorch.core.checks import check_exported
from fmtorch.matching.matcher import NearestNeighborMatcher
from fmtorch.matching.nearest import Neighbors, nearest_neighbors

__all__ = [
    "NearestNeighborMatcher", "Neighbors", "nearest_neighbors",
]  # fmt: skip

check_exported(__name__)
