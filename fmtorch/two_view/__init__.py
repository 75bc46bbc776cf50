"""Matches of two images -> fundamental, essential and homography matrices: what users call."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.two_view.arguments import camera_fields, lens_fields
    from fmtorch.two_view.assumed_sizes import extents
    from fmtorch.two_view.known_cameras import KnownCameras
    from fmtorch.two_view.pair_type import classify

__all__ = [
    "KnownCameras", "camera_fields", "classify", "extents", "lens_fields",
]  # fmt: skip

lazy_exports(__name__)
