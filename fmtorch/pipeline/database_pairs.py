"""Pairs of a COLMAP database as correspondences."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.types import Correspondences, pair_key
from fmtorch.storage.exchange.database_images import DatabaseImage
from fmtorch.two_view.arguments import UNKNOWN

Cameras = Literal["stored", "shared", "unknown"]
"""What is taken for known: the cameras of the database, that both images have one focal length, or nothing."""


class DatabasePair(NamedTuple):
    """A pair of images with its matches, keypoints (n, 2) of both."""

    image0: DatabaseImage
    image1: DatabaseImage
    matches: NDArray[np.int64]


def as_correspondences(pair: DatabasePair, cameras: Cameras) -> Correspondences:
    """The pair as a batch of one, with what is known of its cameras; of pinholes where these are those stored.

    Without image sizes nothing is asked of cameras. Raises ValueError where a stored camera is none that there can be,
    or where the size of one image alone is known.
    """
    images, stored = (pair.image0, pair.image1), cameras == "stored"
    problem = next((image.problem for image in images if image.problem), "") if stored else ""
    if problem:
        raise ValueError(problem)
    fields: dict[str, Any] = {}
    for i, image in enumerate(images):
        points = (image.pinhole if stored else image.points)[pair.matches[:, i]]
        fields[f"x{i}"] = torch.from_numpy(points)[None]
        if image.size is not None:
            fields[f"size{i}"] = torch.tensor([image.size])
        if stored and image.K is not None:
            fields[f"K{i}"] = torch.from_numpy(image.K)[None]
    mask = torch.isfinite(fields["x0"]).all(-1) & torch.isfinite(fields["x1"]).all(-1)
    if any(image.size is not None for image in images):
        focal = [(1.0, image.deviation) for image in images] if stored else [UNKNOWN, UNKNOWN]
        fields["focal"] = torch.tensor([focal], dtype=torch.float64)
        fields["shared_focal"] = torch.tensor([_shared(*images, cameras)])
    elif cameras == "shared":
        raise ValueError("cameras=shared needs the image sizes: size0 and size1, or K0 and K1")
    key = torch.tensor([pair_key(f"{images[0].name} {images[1].name}")])
    return Correspondences(mask=mask, key=key, **fields)


def _shared(image0: DatabaseImage, image1: DatabaseImage, cameras: Cameras) -> bool:
    """Whether both images are known to have one focal length, which is not known exactly."""
    return cameras == "shared" or (
        cameras == "stored" and image0.camera_id == image1.camera_id and image0.deviation > 0
    )
