"""The embedded data set: scenes drawn from known cameras, and a real stereo pair; nothing is downloaded."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.scenes.dataset import FAMILIES, PLANS, Plan, RenderedPairs, StereoPair, Task, build, depth_at
    from fmtorch.scenes.raycast import Camera, calibration, fundamental, look_at, relative_pose
    from fmtorch.scenes.surfaces import PICTURES, photograph, skimage_file

__all__ = [
    "FAMILIES", "PICTURES", "PLANS", "Camera", "Plan", "RenderedPairs", "StereoPair", "Task", "build", "calibration",
    "depth_at", "fundamental", "look_at", "photograph", "relative_pose", "skimage_file",
]  # fmt: skip

lazy_exports(__name__)
