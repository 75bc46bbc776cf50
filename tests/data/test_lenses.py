"""Lens models against their definitions, OpenCV and COLMAP; undistorted images against what a pinhole sees."""

import cv2
import numpy as np
import pytest

from fmtorch.data import Lens
from fmtorch.data.cameras import MODELS, undistorted
from tests.reference import lenses as reference

SIZE = (120, 160)
GIVEN = {"FOV": [0.9], "EUCM": [0.6, 1.1], "OPENCV_FISHEYE": [0.03, -0.02, 0.01, 0.002]}  # in place of random ones


def coefficients(model: str, seed: int = 0) -> tuple[float, ...]:
    count = len(MODELS[model].coefficients.split())
    return tuple(GIVEN.get(model, np.random.default_rng(seed).uniform(-0.05, 0.05, count).tolist()))


def lens(model: str) -> Lens:
    return Lens(110.0, 115.0 if MODELS[model].focals == 2 else 110.0, 78.0, 61.5, model, coefficients(model))


def grid(n: int = 50) -> np.ndarray:
    return np.random.default_rng(1).uniform([0, 0], [SIZE[1], SIZE[0]], (n, 2))


@pytest.mark.parametrize("model", MODELS)
def test_each_model_is_its_definition(model: str) -> None:
    used, points = lens(model), grid()
    for x, there in zip(points, used.distort(points), strict=True):
        u, v = (x[0] - used.cx) / used.fx, (x[1] - used.cy) / used.fy
        u, v = reference.distort(model, u, v, list(used.coefficients))
        np.testing.assert_allclose(there, [used.fx * u + used.cx, used.fy * v + used.cy], rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", MODELS)
def test_each_model_is_colmaps(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    used, points = lens(model), grid()
    there = pycolmap.CameraModelId.__members__
    assert int(there[model]) == list(MODELS).index(model)
    camera = pycolmap.Camera.create_from_model_id(1, there[model], 110.0, SIZE[1], SIZE[0])
    assert [name.strip() for name in camera.params_info.split(",")] == MODELS[model].parameters
    focals = [used.fx, used.fy][: MODELS[model].focals]
    camera.params = [*focals, used.cx, used.cy, *used.coefficients]
    rays = np.column_stack([(points - [used.cx, used.cy]) / [used.fx, used.fy], np.ones(len(points))])
    np.testing.assert_allclose(used.distort(points), camera.img_from_cam(rays), rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_opencvs_models_are_opencvs(model: str) -> None:
    used, points = lens(model), grid()
    rays = np.column_stack([(points - [used.cx, used.cy]) / [used.fx, used.fy], np.ones(len(points))])[:, None]
    project = cv2.fisheye.projectPoints if model == "OPENCV_FISHEYE" else cv2.projectPoints
    there, _ = project(rays, np.zeros(3), np.zeros(3), used.K, np.array(used.coefficients))
    np.testing.assert_allclose(used.distort(points), there[:, 0], rtol=0, atol=1e-9)


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 127 + 60 * np.sin(x / 9) * np.cos(y / 7) + 40 * np.sin((x + 2 * y) / 23)


@pytest.mark.parametrize("model", MODELS)
def test_an_undistorted_photograph_is_what_the_pinhole_sees(model: str) -> None:
    """A photograph is drawn by inverting the lens at each pixel; without distortion it is the texture again."""
    used = lens(model)
    h, w = SIZE
    y, x = np.mgrid[:h, :w].astype(np.float64)
    ideal = np.stack([x, y], -1)
    for _ in range(60):  # fixed-point inversion: the distortion is mild
        ideal -= 0.7 * (used.distort(ideal) - np.stack([x, y], -1))
    np.testing.assert_allclose(used.distort(ideal), np.stack([x, y], -1), atol=1e-3)
    photograph = texture(ideal[..., 0], ideal[..., 1]).round().astype(np.uint8)
    photograph = np.stack([photograph, 255 - photograph, photograph], -1) if model == "OPENCV" else photograph
    result = undistorted(photograph, used)
    assert result.shape == photograph.shape
    inside = np.ones(SIZE, bool)
    there = used.distort(np.stack([x, y], -1))
    for axis, side in ((0, w), (1, h)):
        inside &= (there[..., axis] >= 0) & (there[..., axis] <= side - 1)
    assert inside.mean() > 0.5
    first = result[..., 0] if result.ndim == 3 else result
    error = np.abs(first.astype(float) - texture(x, y))[inside]
    assert error.max() < 6  # grey levels: bilinear interpolation of at most 15 a pixel, and rounding
    assert (first[~inside & (there.min(-1) < -1)] == 0).all()  # beyond the photograph: black


def test_where_a_polynomial_folds_back_the_image_is_black() -> None:
    """With k = -0.5 the distorted radius grows up to sqrt(2/3) and then shrinks: a ghost of the centre would follow."""
    folding = Lens(60.0, 60.0, 79.5, 59.5, "SIMPLE_RADIAL", (-0.5,))
    image = np.full(SIZE, 200, np.uint8)
    result = undistorted(image, folding)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    radius = np.hypot(x - 79.5, y - 59.5) / 60
    turning = np.sqrt(2 / 3)
    assert (result[radius < turning - 0.05] == 200).all()
    assert (result[radius > turning + 0.05] == 0).all()
