"""COLMAP behind our call gives what pycolmap gives when it is called directly, on real pairs, for F, E and H."""

import functools
from typing import Any, NamedTuple

import numpy as np
import pytest

import fmtorch
from fmtorch import data
from fmtorch.core import Correspondences, Estimate
from fmtorch.data import ImagePair
from fmtorch.pipeline import load_pipeline
from tests.conftest import shared_path

pycolmap = pytest.importorskip("pycolmap")
SETS = ("Strecha", "PhotoTourism", "KITTI")
SEED, THRESHOLD = 3, 1.5


class Matched(NamedTuple):
    pair: ImagePair
    c: Correspondences
    x0: np.ndarray
    x1: np.ndarray


@functools.cache
def matched(name: str, index: int = 0) -> Matched:
    """A real pair and its matches, which are also given as COLMAP takes them."""
    pair = data.load("fmbench", root=shared_path(f"data/{name}"))[index]
    c = load_pipeline("sift_ratio").correspondences([pair])[0].correspondences
    x0, x1 = (np.ascontiguousarray(x[0][c.mask[0]].double().numpy()) for x in (c.x0, c.x1))
    return Matched(pair, c, x0, x1)


def options() -> Any:
    """Of COLMAP's verification, at our threshold and seed."""
    geometry_options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
    geometry_options.ransac.max_error, geometry_options.ransac.random_seed = THRESHOLD, SEED
    return geometry_options


def cameras(m: Matched, known: bool) -> list[Any]:
    """COLMAP's cameras of a pair; where they are not known with its default focal length."""
    pinholes = []
    for i, (K, size) in enumerate(((m.pair.K0, m.c.size0), (m.pair.K1, m.c.size1))):
        h, w = size[0].tolist()
        f = 1.2 * max(h, w)
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]] if known else [f, f, (w - 1) / 2, (h - 1) / 2]
        pinholes.append(pycolmap.Camera(camera_id=i + 1, model="PINHOLE", width=w, height=h, params=params))
        pinholes[i].has_prior_focal_length = known
    return pinholes


def verified(m: Matched, first: Any, second: Any) -> Any:
    matches = np.repeat(np.arange(len(m.x0), dtype=np.uint32)[:, None], 2, 1)
    return pycolmap.estimate_two_view_geometry(first, m.x0, second, m.x1, matches, options())


def ours(m: Matched, **changes: Any) -> Estimate:
    given = {"mask": m.c.mask, "size0": m.c.size0, "size1": m.c.size1, "estimator": "colmap", "seed": SEED}
    call = fmtorch.find_essential if "K0" in changes else fmtorch.find_fundamental
    return call(m.c.x0, m.c.x1, **given, threshold=THRESHOLD, **changes)


def unit(F: np.ndarray) -> np.ndarray:
    return F / np.linalg.norm(F)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("two_view", [True, False])
def test_fundamental_matrices_are_colmaps_to_the_last_bit(name: str, two_view: bool) -> None:
    m = matched(name)
    alone = pycolmap.estimate_fundamental_matrix(m.x0, m.x1, options().ransac)
    F, inliers = alone["F"], np.flatnonzero(alone["inlier_mask"])
    if two_view:
        geometry = verified(m, *cameras(m, known=False))
        F, inliers = geometry.F, np.asarray(geometry.inlier_matches)[:, 0]
    estimate = ours(m, two_view=two_view)
    assert bool(estimate.ok[0])
    assert np.array_equal(estimate.F[0].numpy(), unit(F))
    assert np.array_equal(np.flatnonzero(estimate.inliers[0][m.c.mask[0]].numpy()), inliers)


@pytest.mark.parametrize("name", SETS)
def test_poses_of_known_cameras_are_colmaps(name: str) -> None:
    """COLMAP's threshold of rays is of the mean of fx and fy, ours of their geometric mean."""
    m = matched(name)
    result = pycolmap.estimate_essential_matrix(m.x0, m.x1, *cameras(m, known=True), options().ransac)
    estimate = ours(m, K0=m.pair.K0, K1=m.pair.K1, two_view=False)
    assert bool(estimate.ok[0])
    stretch = max(abs(K[0, 0] / K[1, 1] - 1) for K in (m.pair.K0, m.pair.K1))
    tolerance = 1e-7 + stretch**2 / 8  # of the thresholds; rounding of pixels, 1e-13 px, times the condition of the fit
    pose = result["cam2_from_cam1"]
    assert estimate.R[0].numpy() == pytest.approx(pose.rotation.matrix(), abs=tolerance)
    assert estimate.t[0].numpy() == pytest.approx(pose.translation, abs=tolerance)
    assert np.array_equal(estimate.inliers[0][m.c.mask[0]].numpy(), result["inlier_mask"])


@pytest.mark.parametrize("name", SETS)
def test_two_view_geometries_of_known_cameras_are_colmaps(name: str) -> None:
    m = matched(name)
    geometry = verified(m, *cameras(m, known=True))
    assert pycolmap.TwoViewGeometryConfiguration(geometry.config).name == "CALIBRATED"
    estimate = ours(m, K0=m.pair.K0, K1=m.pair.K1)
    tolerance = 1e-7 + max(abs(K[0, 0] / K[1, 1] - 1) for K in (m.pair.K0, m.pair.K1)) ** 2 / 8
    assert estimate.R[0].numpy() == pytest.approx(geometry.cam2_from_cam1.rotation.matrix(), abs=tolerance)
    f = [np.sqrt(K[0, 0] * K[1, 1]) for K in (m.pair.K0, m.pair.K1)]
    assert estimate.focals[0].tolist() == pytest.approx(f)


@pytest.mark.parametrize("name", SETS)
def test_homographies_are_colmaps_and_positive_where_the_plane_is_seen(name: str) -> None:
    m = matched(name)
    result = pycolmap.estimate_homography_matrix(m.x0, m.x1, options().ransac)
    options_of_ours = {"estimator": "colmap", "model": "homography", "threshold": THRESHOLD, "seed": SEED}
    estimate = fmtorch.find_homography(m.c.x0, m.c.x1, mask=m.c.mask, **options_of_ours)
    assert bool(estimate.ok[0])
    H = estimate.H[0].numpy()
    assert np.array_equal(H, unit(result["H"])) or np.array_equal(H, -unit(result["H"]))
    inliers = estimate.inliers[0][m.c.mask[0]].numpy()
    assert np.array_equal(inliers, result["inlier_mask"])
    assert np.median(m.x0[inliers] @ H[2, :2] + H[2, 2]) > 0


@pytest.mark.parametrize("index", [0, 1])
def test_a_shared_focal_length_is_that_of_one_camera_of_colmap(index: int) -> None:
    """Which it finds for some pairs, and for the others it leaves both unknown."""
    m = matched("Strecha", index)
    geometry = verified(m, *[cameras(m, known=False)[0]] * 2)
    estimate = ours(m, focal="shared")
    expected = [np.nan, np.nan] if geometry.camera1 is None else [geometry.camera1.params[0]] * 2
    assert estimate.focals[0].tolist() == pytest.approx(expected, nan_ok=True)
