"""fmtorch: batched, differentiable two-view geometry in PyTorch."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports
from fmtorch.core.version import __version__

if TYPE_CHECKING:
    from fmtorch.core.types import Correspondences, Estimate, Features
    from fmtorch.pipeline.pipeline import Pipeline
    from fmtorch.pipeline.two_images import MatchResult, match
    from fmtorch.two_view.find import find_essential, find_fundamental, find_homography
    from fmtorch.verification.run import Verification
    from fmtorch.verification.verify import verify

__all__ = [
    "Correspondences",
    "Estimate",
    "Features",
    "MatchResult",
    "Pipeline",
    "Verification",
    "__version__",
    "find_essential",
    "find_fundamental",
    "find_homography",
    "match",
    "verify",
]

lazy_exports(__name__)
