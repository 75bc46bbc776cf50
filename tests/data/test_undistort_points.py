"""Points without distortion: the inverse of each lens model, beside COLMAP's, and frames by its derivatives."""

import functools

import numpy as np
import pycolmap
import pytest

from fmtorch.data import Lens
from fmtorch.data.cameras import MODELS, undistorted_frames, undistorted_points

SIZE, FOCAL = (480, 640), 400.0
COEFFICIENTS = {
    "SIMPLE_RADIAL": (-0.15,), "RADIAL": (0.1, -0.05), "OPENCV": (-0.2, 0.05, 1e-3, -2e-3),
    "OPENCV_FISHEYE": (0.02, -0.01, 0.005, -0.002), "FULL_OPENCV": (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.01, 0.001),
    "FOV": (0.9,), "SIMPLE_RADIAL_FISHEYE": (0.03,), "RADIAL_FISHEYE": (0.03, -0.01),
    "THIN_PRISM_FISHEYE": (0.02, -0.01, 1e-3, -1e-3, 0.002, 0.001, 1e-3, -1e-3), "SIMPLE_DIVISION": (-0.2,),
    "DIVISION": (-0.2,), "EUCM": (0.6, 1.1),
}  # fmt: skip


def lens_of(model: str) -> Lens:
    return Lens(FOCAL, FOCAL if MODELS[model].focals == 1 else 1.02 * FOCAL, 321.0, 238.0, model, COEFFICIENTS[model])


def grid(step: int = 16) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(0.0, SIZE[1], step), np.arange(0.0, SIZE[0], step)), -1).reshape(-1, 2)


@pytest.mark.parametrize("model", sorted(COEFFICIENTS))
def test_the_inverse_of_every_model(model: str) -> None:
    lens, points = lens_of(model), grid()
    pinhole = undistorted_points(lens, points)
    seen = np.isfinite(pinhole).all(-1)
    assert seen.mean() > 0.9
    np.testing.assert_allclose(lens.distort(pinhole[seen]), points[seen], atol=1e-6)
    names = set(pycolmap.CameraModelId.__members__)
    if model not in names:
        pytest.skip(f"this pycolmap has no {model}")
    focals = [lens.fx] if MODELS[model].focals == 1 else [lens.fx, lens.fy]
    camera = pycolmap.Camera(
        model=model, width=SIZE[1], height=SIZE[0], params=[*focals, lens.cx, lens.cy, *lens.coefficients]
    )
    theirs = np.asarray(camera.cam_from_img(points)).reshape(-1, 2) @ lens.K[:2, :2].T + lens.K[:2, 2]
    both = seen & np.isfinite(theirs).all(-1)
    assert both.sum() > 0.9 * len(points)
    np.testing.assert_allclose(pinhole[both], theirs[both], rtol=1e-6, atol=1e-4)


def test_nothing_is_taken_from_beyond_the_fold() -> None:
    """r (1 - 0.4 r^2) has its largest value, 0.6086, at 0.9129: no pinhole's point is farther out."""
    lens = Lens(100.0, 100.0, 0.0, 0.0, "SIMPLE_RADIAL", (-0.4,))
    x = undistorted_points(lens, np.array([[0.0, 0.0], [60.0, 0], [61.0, 0], [0, -200.0], [np.nan, 0]]))
    assert x[0].tolist() == [0, 0]
    assert 60 < x[1, 0] < 91.3
    assert np.isnan(x[2:]).all()
    plain = np.array([[3.0, 4.0]])
    assert undistorted_points(Lens(9.0, 9.0, 1.0, 1.0), plain).tolist() == plain.tolist()


def test_frames_follow_the_derivatives() -> None:
    lens = lens_of("OPENCV")
    points = np.random.default_rng(0).uniform(50, 400, (20, 2))
    frames = np.random.default_rng(1).normal(size=(20, 2, 2))
    undistorted = undistorted_frames(functools.partial(undistorted_points, lens), points, frames)
    pinhole = undistorted_points(lens, points)
    step = 1e-3
    for column in (0, 1):  # the lens takes a short step along the frame of the pinhole to one along the photograph's
        back = lens.distort(pinhole + step * undistorted[..., column])
        np.testing.assert_allclose((back - points) / step, frames[..., column], atol=5e-3)
