"""Images resized and turned: where pixels go, and what becomes of the camera."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fmtorch.data import ImageSource, read_image
from fmtorch.data.pairs import Resampling, scaled_size

SIZE = (6, 9)


def numbered_pixels(size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.arange(size[0] * size[1], dtype=np.uint8).reshape(size)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_pixels_are_where_the_matrix_says(turns: int) -> None:
    image, turn = numbered_pixels(), Resampling(None, turns)
    turned = turn(image)
    np.testing.assert_array_equal(turned, np.rot90(image, turns))
    for y in range(SIZE[0]):
        for x in range(SIZE[1]):
            u, v, _ = turn.matrix(SIZE) @ [x, y, 1]
            assert turned[round(v), round(u)] == image[y, x]


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_point_is_seen_at_the_same_place_of_the_image(turns: int) -> None:
    """K' (R X) is where the matrix puts K X; K' is upper triangular with positive focal lengths."""
    change = Resampling((12, 12), turns)
    K, X = np.array([[30, 0, 4.2], [0, 31, 2.9], [0, 0, 1.0]]), np.array([0.3, -0.2, 2.5])
    K_read = change.calibration(K, SIZE)
    seen, moved = K_read @ change.rotation @ X, change.matrix(SIZE) @ K @ X
    np.testing.assert_allclose(seen / seen[2], moved / moved[2], atol=1e-12)
    assert np.linalg.det(change.rotation) == pytest.approx(1)
    assert K_read[1, 0] == pytest.approx(0)
    assert K_read[0, 1] == pytest.approx(0)
    assert min(np.diag(K_read)) > 0


def test_an_image_source_is_resized_then_turned(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    image = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    assert cv2.imwrite(str(path), image)
    change = Resampling((3, 5), 1)
    source = ImageSource("a", path, SIZE, resampling=change)
    small = cv2.resize(image[..., ::-1], (5, 3), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(read_image(source), np.rot90(small))
    assert source.pixels != ImageSource("a", path, SIZE).pixels


def test_sides() -> None:
    assert scaled_size((480, 640), 320 / 640) == (240, 320)
    assert scaled_size((480, 640), 240 / 480) == (240, 320)
    assert scaled_size((10, 4000), 100 / 4000) == (1, 100)
