"""How hard it is to match two patches of a point, by the geometry of the point: GeoDesc's similarity of patches.

Luo, Shen, Zhou, Zhu, Zhang, Yao, Fang, Quan: GeoDesc, ECCV 2018 (arXiv 1807.06294), section 3.3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fmtorch.training.keypoints import Keypoints, Matrix
from fmtorch.training.scenes import View, local_depth

INTERSECTION_SIGMA = 15.0  # degrees, sigma_1 of section 3.3
INCIDENCE_SIGMA = 20.0  # degrees, sigma_2 of section 3.3

Real = NDArray[np.floating]


def rays_and_incidence(keypoints: Keypoints, view: View) -> tuple[Matrix, Matrix]:
    """Of keypoints (n, 4) of a view the directions from the surface to the camera and the incidence angles.

    The normal is that of the plane that the depth shows about the keypoint: where the inverse depth is f^T (x, y, 1) in
    pixels, it is K^T f.

    Returns unit vectors (n, 3) in the world, and the angles (n,) in degrees between them and the normal, in [0, 90];
    NaN where the depth is not that of a plane.
    """
    x = keypoints[:, :2]
    pixel, middle, slope, flat = local_depth(keypoints, view)
    K = view.camera.K
    forms = np.c_[slope, middle - (slope * pixel).sum(1)]
    normals = forms @ K
    rays = np.c_[x, np.ones(len(x))] @ np.linalg.inv(K).T
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (normals * rays).sum(1) / (np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1))
    incidence = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
    towards = -(rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ view.camera.R
    return towards, np.where(flat, incidence, np.nan)


def patch_similarity(rays0: Real, rays1: Real, incidence0: Real, incidence1: Real) -> Matrix:
    """S_patch (section 3.3): g(intersection angle, 15 degrees) g(difference of incidence angles, 20 degrees).

    g(a, s) = exp(-a^2 / (2 s^2)). The intersection angle is that between the two viewing rays at the point, the
    incidence angles are those between ray and surface normal.

    Args:
        rays0, rays1: unit directions (n, 3) from the point to each camera.
        incidence0, incidence1: degrees (n,).

    Returns similarities (n,) in [0, 1]; 1 for the same viewpoint.
    """
    cross = np.linalg.norm(np.cross(rays0, rays1), axis=1)
    intersection = np.degrees(np.arctan2(cross, (rays0 * rays1).sum(1)))
    similarity: Matrix = _closeness(intersection, INTERSECTION_SIGMA) * _closeness(
        incidence0 - incidence1, INCIDENCE_SIGMA
    )
    return similarity


def _closeness(angle: Real, sigma: float) -> Matrix:
    """g of section 3.3, of angles in degrees."""
    return np.exp(-(np.asarray(angle, np.float64) ** 2) / (2 * sigma**2))
