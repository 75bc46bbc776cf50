"""Affine-simulated SIFT: keypoints of many tilted and rotated views of one image (Morel and Yu, SIIMS 2009)."""

import dataclasses
import math
from typing import Annotated

import cv2
import numpy as np
import torch

from fmtorch.core.options import Within
from fmtorch.core.types import Features
from fmtorch.features.patches import Image
from fmtorch.features.sift import SIFT, as_grey, strongest

ROTATION_STEP = 72.0  # degrees, divided by the tilt; section 5.2 of the paper
ANTIALIAS_SIGMA = 0.8  # times sqrt(t^2 - 1), the blur along the axis that is then reduced t times; section 5.1


@dataclasses.dataclass(frozen=True)
class ASIFT(SIFT):
    """SIFT on simulated views of an image, the keypoints mapped back; an instance may be used by several threads.

    A view is the image rotated by an angle, then reduced t times along x: as a camera would see a distant plane from
    latitude arccos(1 / t). The tilts are ``t = sqrt(2)^k``, k = 0 ... tilts - 1, at the angles 0, 72 / t, ... below
    180 degrees: 43 views for the paper's six tilts, about 14 times the area of the image. No tilt is plain SIFT.

    max_features: the strongest kept over all views. The other options are those of `SIFT` in each view.
    """

    max_features: Annotated[int, Within(1)] = 30000
    tilts: int = 6

    def __call__(self, image: Image) -> Features:
        """The features of a grey (H, W) or RGB (H, W, 3) uint8 image; none, with N = 0, where nothing is found.

        lafs: the frames of the views in the image, full affine. scores, descriptors: as found in the views. Frames that
        leave the image are dropped, except in the view that is the image. Raises ValueError for another type, shape or
        an empty image.
        """
        grey = as_grey(image)
        parts = [super().__call__(grey)]
        for tilt, angle in simulated_views(self.tilts)[1:]:
            view, to_view = simulate_view(grey, tilt, angle)
            parts.append(_mapped_back(super().__call__(view), to_view, grey.shape))
        scores = torch.cat([f.scores for f in parts])
        kept = torch.from_numpy(strongest(scores.numpy(), self.max_features))
        lafs, descriptors = (torch.cat([getattr(f, name) for f in parts])[kept] for name in ("lafs", "descriptors"))
        return Features(lafs, scores[kept], descriptors, parts[0].image_size)


def simulated_views(tilts: int) -> list[tuple[float, float]]:
    """(tilt, angle in degrees) of the views, the image itself, (1, 0), first. Raises ValueError for no tilts."""
    if tilts < 1:
        raise ValueError(f"tilts is {tilts}; there must be at least one, which is the image itself")
    views = [(1.0, 0.0)]
    for k in range(1, tilts):
        tilt = math.sqrt(2) ** k
        views += [(tilt, i * ROTATION_STEP / tilt) for i in range(math.ceil(180 * tilt / ROTATION_STEP - 1e-9))]
    return views


def simulate_view(grey: Image, tilt: float, angle: float) -> tuple[Image, np.ndarray]:
    """The view of a grey image rotated by `angle` degrees and reduced `tilt` times along x, and the map to it (2, 3).

    The border of the image is continued where the view shows more. Blurred before it is reduced.
    """
    h, w = grey.shape
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    corners = rotation @ np.array([[0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1]])
    low, high = corners.min(1), corners.max(1)
    width, height = (math.ceil(extent - 1e-6) + 1 for extent in high - low)
    rotate = np.concatenate([rotation, -low[:, None]], 1)
    turned = cv2.warpAffine(grey, rotate, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    blurred = cv2.GaussianBlur(turned, (0, 0), sigmaX=ANTIALIAS_SIGMA * math.sqrt(tilt**2 - 1), sigmaY=0.01)
    reduce = np.array([[1 / tilt, 0, 0], [0, 1, 0]])
    narrow = math.floor((width - 1) / tilt) + 1
    view = cv2.warpAffine(blurred, reduce, (narrow, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return view.astype(np.uint8, copy=False), reduce[:, :2] @ rotate


def _mapped_back(features: Features, to_view: np.ndarray, shape: tuple[int, ...]) -> Features:
    """The features of a view in the image's coordinates, without those whose frame leaves the image."""
    to_image = torch.from_numpy(np.linalg.inv(to_view[:, :2]))
    lafs = features.lafs.double()
    centre = (lafs[..., 2] - torch.from_numpy(to_view[:, 2])) @ to_image.T
    half_side = torch.linalg.vector_norm(lafs[..., 0], dim=-1)
    # A circle of the view reaches |row of the map| times its radius in the image.
    reach = half_side[:, None] * torch.linalg.vector_norm(to_image, dim=1)
    far = torch.tensor([shape[1] - 1, shape[0] - 1], dtype=centre.dtype)
    kept = ((centre >= reach) & (centre <= far - reach)).all(-1)
    mapped = torch.cat([to_image @ lafs[..., :2], centre[..., None]], -1)
    return features.replace(lafs=mapped.float())[kept]
