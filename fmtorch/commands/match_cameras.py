"""What `python -m fmtorch.match` is told of cameras: ``cameras=exif``, ``cameras=FILE``, ``K=fx,fy,cx,cy``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from fmtorch.data.images import read_image
from fmtorch.data.undistort import undistorted
from fmtorch.pipeline.photograph_cameras import PhotographCameras
from fmtorch.pipeline.reduced_images import Image
from fmtorch.pipeline.two_images import MatchResult


@dataclasses.dataclass(frozen=True, eq=False)
class Photographs:
    """Two photographs, and what is known of their cameras as `fmtorch.match` takes it; notes: what is said of these."""

    images: tuple[Image, Image]
    knowledge: dict[str, Any]
    notes: tuple[str, ...] = ()

    @property
    def pinholes(self) -> tuple[Image, Image]:
        """The photographs without the distortion of their lenses."""
        lenses = [self.knowledge.get(f"lens{i}") for i in (0, 1)]
        bent = zip(self.images, lenses, strict=True)
        image0, image1 = (image if lens is None else undistorted(image, lens) for image, lens in bent)
        return image0, image1


def photographs(
    paths: Sequence[Path], cameras: Path | None, K: str | list[float | int] | None, orient: bool
) -> Photographs:
    """Read two photographs with what is known of their cameras.

    Args:
        paths: of the two.
        cameras: one of `WORDS`, a file of cameras (`ImageCameras`), or None.
        K: fx, fy, cx, cy of both in pixels, or None.
        orient: turn them as their EXIF orientation says.

    Raises:
        ValueError: where both are given, or for what no camera is.
        ImageError: for a file that is no image, or is not of its camera's size.
    """
    known = PhotographCameras(cameras, K)
    image0, image1 = (read_image(known.source(path), orient=orient) for path in paths)
    ends = zip(paths, (image0, image1), strict=True)
    camera0, camera1 = (known.of(path, (image.shape[0], image.shape[1])) for path, image in ends)
    notes = tuple(filter(None, (camera0.note, camera1.note)))
    return Photographs((image0, image1), known.knowledge(camera0, camera1), notes)


def pose_report(result: MatchResult) -> dict[str, Any]:
    """R, t and focal lengths of result.json; None where they are not determined, nothing where nobody asked."""
    if result.R is None or result.t is None or result.focals is None:
        return {}
    determined = result.ok and bool(torch.isfinite(result.R).all())
    focals = [focal if math.isfinite(focal) else None for focal in result.focals.tolist()]
    R, t = (value.tolist() if determined else None for value in (result.R, result.t))
    return {"R": R, "t": t, "focals": focals}


def pose_line(result: MatchResult) -> str:
    """``rotation 12.3°, translation (0.98, -0.10, 0.17), focal lengths 702, 702 px``; empty where nobody asked."""
    if result.R is None or result.t is None or result.focals is None or not result.ok:
        return ""
    focals = ", ".join(f"{focal:.0f}" if math.isfinite(focal) else "?" for focal in result.focals.tolist())
    if not bool(torch.isfinite(result.R).all()):
        return f"no pose: it is not determined; focal lengths {focals} px"
    half = (result.R - torch.eye(3).to(result.R)).norm() / math.sqrt(8)  # the sine of half the angle
    angle = math.degrees(2 * math.asin(min(1.0, float(half))))
    direction = ", ".join(f"{value:.3f}" for value in result.t.tolist())
    return f"rotation {angle:.2f}°, translation ({direction}), focal lengths {focals} px"
