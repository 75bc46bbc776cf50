"""Pairs of a COLMAP database as correspondences."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.types import Correspondences, pair_key
from fmtorch.pipeline.camera_arguments import UNKNOWN
from fmtorch.storage.exchange.database_images import DatabaseImage

Cameras = Literal["stored", "shared", "unknown"]
"""What is taken for known: the cameras of the database, that both images have one focal length, or nothing."""


class DatabasePair(NamedTuple):
    """A pair of images with its matches, keypoints (n, 2) of both."""

    image0: DatabaseImage
    image1: DatabaseImage
    matches: NDArray[np.int64]


def as_correspondences(pair: DatabasePair, cameras: Cameras) -> Correspondences:
    """The pair as a batch of one, with what is known of its cameras; of pinholes where these are those stored.

    Raises ValueError where a stored camera is none that there can be.
    """
    images, stored = (pair.image0, pair.image1), cameras == "stored"
    problem = next((image.problem for image in images if image.problem), "") if stored else ""
    if problem:
        raise ValueError(problem)
    fields: dict[str, Any] = {}
    for i, image in enumerate(images):
        index = pair.matches[:, i]
        points = (image.pinhole if stored else image.points)[index]
        frames = image.pinhole_frames if stored else image.frames
        fields[f"x{i}"] = torch.from_numpy(points)[None]
        fields[f"size{i}"] = torch.tensor([image.size])
        if frames is not None:
            fields[f"lafs{i}"] = torch.from_numpy(np.concatenate([frames[index], points[..., None]], -1))[None]
        if stored:
            fields[f"K{i}"] = torch.from_numpy(image.K)[None]
    if "lafs0" not in fields or "lafs1" not in fields:
        fields = {name: value for name, value in fields.items() if not name.startswith("lafs")}
    mask = torch.isfinite(fields["x0"]).all(-1) & torch.isfinite(fields["x1"]).all(-1)
    focal = [(1.0, image.deviation) for image in images] if stored else [UNKNOWN, UNKNOWN]
    key = torch.tensor([pair_key(f"{images[0].name} {images[1].name}")])
    return Correspondences(
        mask=mask, key=key, focal=torch.tensor([focal], dtype=torch.float64),
        shared_focal=torch.tensor([_shared(*images, cameras)]), **fields,
    )  # fmt: skip


def _shared(image0: DatabaseImage, image1: DatabaseImage, cameras: Cameras) -> bool:
    """Whether both images are known to have one focal length, which is not known exactly."""
    return cameras == "shared" or (
        cameras == "stored" and image0.camera_id == image1.camera_id and image0.deviation > 0
    )
