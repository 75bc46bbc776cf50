"""Pictures: any two sizes fit, what is drawn stands where it should, lines end at the border."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmtorch.pipeline.pictures import (
    BAD,
    COLOURS,
    GOOD,
    HEIGHT,
    WIDTH,
    Place,
    draw_epipolar_lines,
    draw_epipolar_lines_of_corners,
    draw_matches,
    spread,
)

ROWS = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a sideways camera: epipolar lines are rows
NONE = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)


def grey(h: int, w: int) -> np.ndarray:
    return np.full((h, w, 3), 128, np.uint8)


def near(picture: np.ndarray, colour: tuple[int, int, int], tolerance: int = 60) -> np.ndarray:
    return (np.abs(picture.astype(int) - colour) <= tolerance).all(-1)


@pytest.mark.parametrize(
    ("shape0", "shape1"),
    [
        ((640, 480), (480, 640)),  # portrait beside landscape
        ((1, 500), (480, 640)),
        ((370, 1226), (370, 1226)),
        ((100, 3000), (3000, 100)),
        ((1, 1), (1, 1)),
    ],
)
def test_any_two_images_fit(shape0: tuple[int, int], shape1: tuple[int, int]) -> None:
    image0, image1 = grey(*shape0), grey(*shape1)[..., 0]  # one in colour, one grey
    for picture in (draw_matches(image0, image1, *NONE), draw_epipolar_lines(image0, image1, *NONE[:2], ROWS)):
        assert picture.dtype == np.uint8
        assert picture.shape[0] <= HEIGHT + 1  # each of two sizes is rounded
        assert picture.shape[1] <= WIDTH + 1
        assert picture.shape[0] >= HEIGHT - 1 or picture.shape[1] >= WIDTH - 1
        assert (picture == 128).any()


def test_matches_are_drawn_between_their_points() -> None:
    x0, x1 = np.array([[10.0, 20], [60, 70]]), np.array([[30.0, 20], [60, 10]])
    picture = draw_matches(grey(80, 100), grey(80, 100), x0, x1, np.array([True, False]), height=800)
    scale, offset = 10, 1000 + 6
    assert picture.shape == (800, 2006, 3)
    # (0, 0) is the centre of the first pixel: pixel x is drawn around 10 x + 4.5.
    for x, colour in ((x0[0], GOOD), (x1[0] + [offset / scale, 0], GOOD), (x0[1], BAD), (x1[1] + [100.6, 0], BAD)):
        column, row = (x * scale + 4.5).round().astype(int)
        assert near(picture, colour)[row - 1 : row + 2, column - 1 : column + 2].any()
    ys, xs = np.nonzero(near(picture, GOOD, 30))
    assert abs(ys - 204.5).max() < 10
    assert xs.min() > 90
    assert xs.max() < offset + 320


def test_epipolar_lines_run_through_the_points_and_the_truth_is_white() -> None:
    x0, x1 = np.array([[20.0, 30], [70, 60]]), np.array([[40.0, 30], [50, 60]])
    images = np.zeros((90, 100, 3), np.uint8), np.zeros((90, 100, 3), np.uint8)
    picture = draw_epipolar_lines(*images, x0, x1, ROWS)
    scale = picture.shape[0] / 90
    for k, y in enumerate((30, 60)):
        row = round((y + 0.5) * scale - 0.5)
        drawn = near(picture, COLOURS[k], 40)[row - 1 : row + 2].any(0)
        assert drawn.mean() > 0.9  # across both images, but for the gap and the points' white rings
    # A true F whose lines are the rows 9 px below in image 1.
    T = np.array([[1.0, 0, 0], [0, 1, -9], [0, 0, 1]])
    with_truth = draw_epipolar_lines(*images, x0, x1, ROWS, truth=T.T @ ROWS)
    row = round((30 + 9 + 0.5) * scale - 0.5)
    white = near(with_truth, (255, 255, 255), 100)[row - 1 : row + 2].any(0)
    half = with_truth.shape[1] // 2 + 10
    assert 0.4 < white[half:].mean() < 0.7  # dashed
    assert not white[: half - 20].any()


def test_corners_have_their_lines_in_the_other_image() -> None:
    images = np.zeros((2, 90, 100, 3), np.uint8)
    for k in range(4):  # dots, no two of one height
        images[0, 12 + 16 * k : 14 + 16 * k, 20 * k + 10 : 20 * k + 12] = 255
        images[1, 20 + 16 * k : 22 + 16 * k, 80 - 20 * k : 82 - 20 * k] = 255
    picture = draw_epipolar_lines_of_corners(images[0], images[1], ROWS)
    half = picture.shape[1] // 2
    sides = picture[:, : half - 10], picture[:, half + 10 :]
    heights = set()
    for k in range(7):
        points, lines = sides if k < 4 else sides[::-1]
        share = near(lines, COLOURS[k], 40).mean(1)
        (row,) = np.flatnonzero(np.diff((share > 0.5).astype(int)) == 1)  # one line, which runs across
        own = np.flatnonzero(near(points, COLOURS[k], 40).any(1))
        assert abs(own.mean() - row) < 5  # px of the picture, of eleven to one of the images
        heights.add(row)
    assert len(heights) == 7
    blank = draw_epipolar_lines_of_corners(grey(50, 60), grey(50, 60), ROWS)  # without corners there is nothing to draw
    assert (blank[10:-10, 10:50] == 128).all()
    for shape in ((1, 1), (1, 500), (8, 8)):
        assert draw_epipolar_lines_of_corners(grey(*shape), grey(480, 640)[..., 0], ROWS).size


finite = st.floats(-100, 100)


@given(finite, finite, st.floats(-5000, 5000), st.integers(1, 60), st.integers(1, 60))
def test_lines_end_at_the_border(a: float, b: float, c: float, h: int, w: int) -> None:
    place = Place((h, w), (0, 0), (w, h))  # drawn as large as the image is
    ends = place.clip(np.array([a, b, c]))
    norm = float(np.hypot(a, b))
    if norm < 1e-3:  # its distance from the image is beyond float64
        return
    if len(ends) == 0:
        # The line misses the image, up to rounding: all corners are on one side.
        corners = np.array([[x, y] for x in (-0.5, w - 0.5) for y in (-0.5, h - 0.5)])
        value = corners @ [a, b] + c
        assert (value > -1e-6 * norm).all() or (value < 1e-6 * norm).all()
        return
    # Rounding: coordinates of some 1e4 / norm px away from the foot, in float64.
    assert np.abs(ends @ [a, b] + c).max() <= 1e-9 * (norm * 100 + abs(c))
    assert (ends >= -0.5 - 1e-6).all()
    assert (ends <= np.array([w, h]) - 0.5 + 1e-6).all()


def test_a_line_that_is_none_is_not_drawn() -> None:
    place = Place((10, 10), (0, 0), (10, 10))
    for line in ([0.0, 0, 1], [np.nan, 1, 0], [np.inf, 1, 0]):
        assert place.clip(np.array(line)).shape == (0, 2)


def test_spread_takes_points_far_apart() -> None:
    points = np.random.default_rng(0).normal(0, 0.01, (200, 2))
    points[[20, 90, 150]] = [[5, 0], [0, 5], [-5, -5]]
    chosen = spread(points, 4)
    assert {20, 90, 150} < set(chosen.tolist())
    assert (np.diff(chosen) > 0).all()
    assert np.array_equal(spread(points[:3], 4), np.arange(3))
    assert len(spread(np.zeros((5, 2)), 3)) == 3
    assert len(spread(np.zeros((0, 4)), 3)) == 0
