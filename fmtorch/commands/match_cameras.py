"""What `python -m fmtorch.match` is told of cameras: ``cameras=exif``, ``cameras=FILE``, ``K=fx,fy,cx,cy``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.data.exif import exif_focal
from fmtorch.data.image_cameras import ImageCameras
from fmtorch.data.images import read_image
from fmtorch.data.pairs import ImageSource
from fmtorch.pipeline.reduced_images import Image
from fmtorch.pipeline.two_images import MatchResult

WORDS = ("unknown", "shared", "exif")


@dataclasses.dataclass(frozen=True)
class CameraFields:
    """What the command takes of cameras; ``conf/match.yaml`` says what each is."""

    cameras: Path | None = None
    K: str | list[float | int] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Photographs:
    """Two photographs, and what is known of their cameras as `fmtorch.match` takes it; notes: what is said of these."""

    images: tuple[Image, Image]
    knowledge: dict[str, Any]
    notes: tuple[str, ...] = ()


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
    if K is not None and cameras is not None:
        raise ValueError("cameras and K are given; give one of them")
    if cameras is not None and str(cameras) not in WORDS:
        return _with_lenses(paths, cameras, orient)
    image0, image1 = (read_image(path, orient=orient) for path in paths)
    images = image0, image1
    if K is not None:
        matrix = _calibration(*_four(K))
        return Photographs(images, {"K0": matrix, "K1": matrix})
    if cameras is None:
        return Photographs(images, {})
    return _by_exif(paths, images) if str(cameras) == "exif" else Photographs(images, {"focal": str(cameras)})


def _with_lenses(paths: Sequence[Path], cameras: Path, orient: bool) -> Photographs:
    """The photographs without the distortion of their lenses."""
    if not cameras.exists():
        known_words = f"it must be {', '.join(WORDS)}, a COLMAP model or a JSON file"
        raise ValueError(f"cameras={cameras}: no such file; {known_words}. One calibration is K=fx,fy,cx,cy")
    known = ImageCameras(cameras)
    images, knowledge, notes = list[Image](), dict[str, Any](), list[str]()
    for i, path in enumerate(paths):
        lens, size = known.of(path)
        bent = lens if lens is not None and lens.bends else None
        images.append(read_image(ImageSource(path.name, path, size, bent), orient=orient))
        knowledge[f"K{i}"] = None if lens is None else lens.K
        if bent is not None:
            notes.append(f"{path.name}: points and F are of the image without the distortion of its {bent.model} lens")
    if all(K is None for K in knowledge.values()):
        knowledge["focal"] = "unknown"
    return Photographs((images[0], images[1]), knowledge, tuple(notes))


def _by_exif(paths: Sequence[Path], images: tuple[Image, Image]) -> Photographs:
    """Focal lengths from EXIF data, of either photograph, both or none."""
    found = [exif_focal(path, (image.shape[0], image.shape[1])) for path, image in zip(paths, images, strict=True)]
    notes = tuple(
        f"{path.name}: focal length not known: {f.source}" for path, f in zip(paths, found, strict=True) if not f.known
    )
    if not any(each.known for each in found):
        return Photographs(images, {"focal": "unknown"}, notes)
    measured = [(each.focal, each.deviation) if each.known else None for each in found]
    return Photographs(images, {"focal": measured}, notes)


def _four(K: str | list[float | int]) -> list[float]:
    """fx, fy, cx, cy. Raises ValueError for anything else."""
    words = K.replace(",", " ").replace("[", " ").replace("]", " ").split() if isinstance(K, str) else K
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)) or min(numbers[:2]) <= 0:
        raise ValueError(f"K={K}; it must be fx,fy,cx,cy in pixels, with positive focal lengths")
    return numbers


def _calibration(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def pose_report(result: MatchResult) -> dict[str, Any]:
    """R, t and focal lengths of result.json; None where they are not determined, nothing where nobody asked."""
    if result.R is None or result.t is None or result.focals is None:
        return {}
    determined = result.ok and bool(torch.isfinite(result.R).all())
    focals = [focal if math.isfinite(focal) else None for focal in result.focals.tolist()]
    R, t = (value.tolist() if determined else None for value in (result.R, result.t))
    return {"R": R, "t": t, "focals": focals, "configuration": result.configuration}


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
