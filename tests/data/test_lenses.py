"""Lenses: images and points without distortion; resampling."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from fmtorch.core.lenses import lines_of_sight, undistortion
from fmtorch.data import MODELS, ImageSource, Lens, read_image, undistorted, undistorted_points
from fmtorch.data.pairs import Resampling

SIZE = (120, 160)
RESAMPLED_SIZE = (6, 9)
COEFFICIENTS = {
    "SIMPLE_RADIAL": (-0.15,), "RADIAL": (0.1, -0.05), "OPENCV": (-0.2, 0.05, 1e-3, -2e-3),
    "OPENCV_FISHEYE": (0.02, -0.01, 0.005, -0.002), "FULL_OPENCV": (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.01, 0.001),
    "FOV": (0.9,), "SIMPLE_RADIAL_FISHEYE": (0.03,), "RADIAL_FISHEYE": (0.03, -0.01),
    "THIN_PRISM_FISHEYE": (0.02, -0.01, 1e-3, -1e-3, 0.002, 0.001, 1e-3, -1e-3), "SIMPLE_DIVISION": (-0.2,),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.02, -0.01, 0.03, 0.01, -0.02, 0.04, 1e-3, -1e-3, 0.002, 0.001, 1e-3, -1e-3),
    "DIVISION": (-0.2,), "EUCM": (0.6, 1.1),
}  # fmt: skip


def lens(model: str) -> Lens:
    return Lens(110.0, 115.0 if MODELS[model].focals == 2 else 110.0, 78.0, 61.5, model, COEFFICIENTS.get(model, ()))


def grid(step: int = 4) -> np.ndarray:
    sides = (np.arange(0.0, side, step) for side in SIZE[::-1])
    return np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)


@pytest.mark.parametrize("model", MODELS)
def test_each_model_and_its_inverse_are_colmaps(model: str) -> None:
    used, points = lens(model), grid()
    there = pycolmap.CameraModelId.__members__
    assert int(there[model]) == list(MODELS).index(model)
    camera = pycolmap.Camera.create_from_model_id(1, there[model], 110.0, SIZE[1], SIZE[0])
    assert [name.strip() for name in camera.params_info.split(",")] == MODELS[model].parameters
    focals = [used.fx, used.fy][: MODELS[model].focals]
    camera.params = [*focals, used.cx, used.cy, *used.coefficients]
    rays = np.column_stack([(points - [used.cx, used.cy]) / [used.fx, used.fy], np.ones(len(points))])
    np.testing.assert_allclose(used.distort(points), camera.img_from_cam(rays), rtol=0, atol=1e-9)
    pinhole = undistorted_points(used, points)
    seen = np.isfinite(pinhole).all(-1)
    assert seen.mean() > 0.9
    np.testing.assert_allclose(used.distort(pinhole[seen]), points[seen], atol=1e-6)
    theirs = np.asarray(camera.cam_from_img(points)).reshape(-1, 2) @ used.K[:2, :2].T + used.K[:2, 2]
    both = seen & np.isfinite(theirs).all(-1)
    assert both.sum() > 0.9 * len(points)
    np.testing.assert_allclose(pinhole[both], theirs[both], rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "RADIAL_FISHEYE", "DIVISION", "EUCM"])
def test_lines_of_sight_all_around(model: str) -> None:
    """Of a small image, in front of the camera and behind it, by the authors' equations of where a ray meets it."""
    used, points = Lens(40.0, 40.0, 78.0, 61.5, model, COEFFICIENTS[model]), grid()
    x, behind = lines_of_sight(used, points)
    X = np.c_[(x - [78.0, 61.5]) / 40, np.ones(len(x))] * np.where(behind, -1, 1)[:, None]
    u, r, c = (points - [78.0, 61.5]) / 40, np.hypot(X[:, 0], X[:, 1])[:, None], used.coefficients
    if model == "EUCM":
        there = X[:, :2] / (c[0] * np.sqrt(c[1] * r * r + 1) + (1 - c[0]) * X[:, 2:])
    elif model == "DIVISION":
        there = X[:, :2] / X[:, 2:] * (1 + c[0] * (u**2).sum(1, keepdims=True))
        assert ((X[:, :2] * u).sum(1) >= 0).all()
    else:
        theta = np.arctan2(r, X[:, 2:])
        there = X[:, :2] / r * sum(k * theta ** (2 * i + 1) for i, k in enumerate((1.0, *c)))
    seen = np.isfinite(x).all(1)
    assert seen.mean() > 0.6
    assert behind.sum() > 15
    np.testing.assert_allclose(there[seen], u[seen], atol=1e-7)
    np.testing.assert_allclose(used.distort(x[seen], behind[seen]), points[seen], atol=1e-6)
    away = seen & (np.abs(X[:, 2]) > 0.05 * r[:, 0])
    J = undistortion(used, x[away], behind[away])
    for axis, step in enumerate(1e-4 * np.eye(2)):
        ends = [lines_of_sight(used, points[away] + sign * step)[0] for sign in (1, -1)]
        assert (np.abs(J[..., axis] - (ends[0] - ends[1]) / 2e-4) <= 1e-3 * np.abs(J).max((1, 2))[:, None]).all()


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 127 + 60 * np.sin(x / 9) * np.cos(y / 7) + 40 * np.sin((x + 2 * y) / 23)


@pytest.mark.parametrize("model", MODELS)
def test_an_undistorted_photograph_is_what_the_pinhole_sees(model: str) -> None:
    """A photograph is drawn by the inverse of the lens at each pixel; without distortion it is the texture again."""
    used = lens(model)
    h, w = SIZE
    y, x = np.mgrid[:h, :w].astype(np.float64)
    ideal = undistorted_points(used, np.stack([x, y], -1))
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
    result = undistorted(np.full(SIZE, 200, np.uint8), folding)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    radius = np.hypot(x - 79.5, y - 59.5) / 60
    turning = np.sqrt(2 / 3)
    assert (result[radius < turning - 0.05] == 200).all()
    assert (result[radius > turning + 0.05] == 0).all()


def test_nothing_is_taken_from_beyond_the_fold() -> None:
    """r (1 - 0.4 r^2) has its largest value, 0.6086, at 0.9129: no pinhole's point is farther out."""
    lens = Lens(100.0, 100.0, 0.0, 0.0, "SIMPLE_RADIAL", (-0.4,))
    x = undistorted_points(lens, np.array([[0.0, 0.0], [60.0, 0], [61.0, 0], [0, -200.0], [np.nan, 0]]))
    assert x[0].tolist() == [0, 0]
    assert 60 < x[1, 0] < 91.3
    assert np.isnan(x[2:]).all()
    plain = np.array([[3.0, 4.0]])
    assert undistorted_points(Lens(9.0, 9.0, 1.0, 1.0), plain).tolist() == plain.tolist()


@pytest.mark.parametrize("model", MODELS)
def test_derivatives_of_every_model(model: str) -> None:
    used, points, step = lens(model), np.random.default_rng(0).uniform(30, 100, (20, 2)), 0.1 * np.eye(2)
    inverse = np.linalg.inv(used.derivatives(undistorted_points(used, points)))
    for column, along in enumerate(step):
        ends = [undistorted_points(used, points + sign * along) for sign in (1, -1)]
        np.testing.assert_allclose(inverse[..., column], (ends[0] - ends[1]) / 0.2, atol=1e-5)


def test_a_point_is_undistorted_alone_as_among_others() -> None:
    used, points = lens("OPENCV_FISHEYE"), grid()
    together = undistorted_points(used, points)
    for part in (slice(7, 9), slice(None, None, 3)):
        assert np.array_equal(together[part], undistorted_points(used, points[part]), equal_nan=True)


def test_a_resampled_photograph_has_a_lens_like_its_own() -> None:
    used, points, scale = lens("OPENCV"), grid(), np.array([0.5, 0.25])
    reduced = used.scaled(*scale).distort((points + 0.5) * scale - 0.5)
    np.testing.assert_allclose((reduced + 0.5) / scale - 0.5, used.distort(points), atol=1e-9)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_pixels_are_where_the_matrix_says(turns: int) -> None:
    image, turn = np.arange(54, dtype=np.uint8).reshape(RESAMPLED_SIZE), Resampling(None, turns)
    turned = turn(image)
    np.testing.assert_array_equal(turned, np.rot90(image, turns))
    for y in range(RESAMPLED_SIZE[0]):
        for x in range(RESAMPLED_SIZE[1]):
            u, v, _ = turn.matrix(RESAMPLED_SIZE) @ [x, y, 1]
            assert turned[round(v), round(u)] == image[y, x]
    # K' (R X) is where the matrix puts K X; K' is upper triangular with positive focal lengths.
    change = Resampling((12, 12), turns)
    K, X = np.array([[30, 0, 4.2], [0, 31, 2.9], [0, 0, 1.0]]), np.array([0.3, -0.2, 2.5])
    K_read = change.calibration(K, RESAMPLED_SIZE)
    seen, moved = K_read @ change.rotation @ X, change.matrix(RESAMPLED_SIZE) @ K @ X
    np.testing.assert_allclose(seen / seen[2], moved / moved[2], atol=1e-12)
    assert np.linalg.det(change.rotation) == pytest.approx(1)
    assert (K_read[1, 0], K_read[0, 1]) == (pytest.approx(0), pytest.approx(0))
    assert min(np.diag(K_read)) > 0


def test_an_image_source_is_resized_then_turned(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    image = np.random.default_rng(0).integers(0, 256, (*RESAMPLED_SIZE, 3), np.uint8)
    assert cv2.imwrite(str(path), image)
    source = ImageSource("a", path, RESAMPLED_SIZE, resampling=Resampling((3, 5), 1))
    small = cv2.resize(image[..., ::-1], (5, 3), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(read_image(source), np.rot90(small))
    assert source.pixels != ImageSource("a", path, RESAMPLED_SIZE).pixels
