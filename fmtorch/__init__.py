"""fmtorch: batched, differentiable two-view geometry in PyTorch."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports
from fmtorch.core.version import __version__

if TYPE_CHECKING:
    from fmtorch.core.lenses import Lens
    from fmtorch.core.types import Correspondences, Estimate, Features, PoseEstimate
    from fmtorch.io.exchange import (
        from_colmap,
        from_kornia,
        from_lightglue,
        from_opencv,
        from_poselib,
        to_colmap,
        to_poselib,
    )
    from fmtorch.pipeline.pictures import draw_epipolar_lines, draw_matches
    from fmtorch.pipeline.pipeline import Pipeline
    from fmtorch.pipeline.two_images import MatchResult, match
    from fmtorch.two_view.find import find_essential, find_fundamental, find_homography
    from fmtorch.verification.verify import Verification, verify

__all__ = [
    "Correspondences",
    "Estimate",
    "Features",
    "Lens",
    "MatchResult",
    "Pipeline",
    "PoseEstimate",
    "Verification",
    "__version__",
    "draw_epipolar_lines",
    "draw_matches",
    "find_essential",
    "find_fundamental",
    "find_homography",
    "from_colmap",
    "from_kornia",
    "from_lightglue",
    "from_opencv",
    "from_poselib",
    "match",
    "to_colmap",
    "to_poselib",
    "verify",
]

lazy_exports(__name__)
