"""fmtorch: batched, differentiable two-view geometry in PyTorch."""

__version__ = "0.1.0"

from fmtorch.fundamental import find_fundamental
from fmtorch.photographs import MatchResult, match
from fmtorch.types import Correspondences, Estimate, Features

__all__ = ["Correspondences", "Estimate", "Features", "MatchResult", "__version__", "find_fundamental", "match"]
