"""Images of known calibration as square pixels, against the definition; and what is no calibration."""

import numpy as np
import pytest
import torch

from fmtorch.geometry.cameras import PixelFrame, calibration_problems, mapped, square_pixels
from tests.reference import known_cameras as reference

SIZE = torch.tensor([[480, 640]])
GOOD = torch.tensor([[[500.0, 2, 310], [0, 520, 250], [0, 0, 1]]], dtype=torch.float64)
RIGHT = torch.tensor([True])


def test_they_are_those_of_the_definition() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        K = np.array([[rng.uniform(300, 900), rng.normal(0, 5), 320], [0, rng.uniform(300, 900), 240], [0, 0, 1]])
        A, square = reference.square(K, (480, 640))
        for scale in (1.0, -2.0):  # K is homogeneous
            square_map = square_pixels(torch.from_numpy(scale * K)[None], SIZE, RIGHT)
            np.testing.assert_allclose(square_map.map[0], A, rtol=1e-12, atol=1e-9)
            assert float(square_map.focal) == pytest.approx(square[0, 0], rel=1e-12)
        x = rng.uniform(0, 600, (1, 50, 2))
        expected = np.c_[x[0], np.ones(50)] @ A.T
        np.testing.assert_allclose(mapped(torch.from_numpy(x), square_map.map)[0], expected[:, :2], atol=1e-9)


def test_an_image_of_unknown_size_is_central() -> None:
    square_map = square_pixels(GOOD, None, RIGHT)
    assert square_map.size.tolist() == [[501.0, 621.0]]
    middle = mapped(torch.tensor([[[310.0, 250.0]]], dtype=torch.float64), square_map.map)
    torch.testing.assert_close(middle, torch.tensor([[[310.0, 250.0]]], dtype=torch.float64))


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e3, 1e9])
@pytest.mark.parametrize("central", [True, False])
def test_the_unit_of_normalised_points_does_not_matter(scale: float, central: bool) -> None:
    """They are mapped to an image of 1000 px of focal length; pixels keep their unit."""
    K = torch.diag(torch.tensor([1.5, 1.5, 1.0], dtype=torch.float64))
    K[:2, 2] = torch.tensor([0.5, 0.4]) if central else 0.0
    K[:2] *= scale
    square_map = square_pixels(K[None], None, RIGHT)
    assert float(square_map.focal) == pytest.approx(1500.0 if scale == 1e3 else 1000.0)
    point = K[:2, 2] + K[0, 0] * torch.tensor([0.3, -0.2])
    (at,) = mapped(point[None, None], square_map.map)[0]
    centre = (square_map.size[0].flip(0) - 1) / 2
    torch.testing.assert_close((at - centre) / square_map.focal, torch.tensor([0.3, -0.2], dtype=torch.float64))


def test_gradients_reach_the_calibration_and_are_those_of_a_constant_image() -> None:
    x = torch.tensor([[[100.0, 50.0], [600.0, 400.0]]], dtype=torch.float64)
    K = GOOD.clone().requires_grad_()
    square = square_pixels(K, SIZE, RIGHT)
    (gradient,) = torch.autograd.grad((mapped(x, square.map) * torch.tensor([1.0, 3.0])).sum(), K)
    C = np.array([[float(square.focal), 0, 319.5], [0, float(square.focal), 239.5], [0, 0, 1]])

    def value(K: np.ndarray) -> float:
        return float((np.c_[x[0], np.ones(2)] @ (C @ np.linalg.inv(K)).T)[:, :2].sum(0) @ [1, 3])

    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)):
        step = np.zeros((3, 3))
        step[i, j] = 1e-3
        numeric = (value(GOOD[0].numpy() + step) - value(GOOD[0].numpy() - step)) / 2e-3
        assert float(gradient[0, i, j]) == pytest.approx(numeric, rel=1e-6)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ([(0, 0, np.nan)], "not finite"),
        ([(0, 0, 0.0)], "singular"),
        ([(2, 2, 0.0)], "singular"),
        ([(1, 0, 3.0)], "rows must be"),
        ([(2, 1, 1e-3)], "rows must be"),
        ([(1, 1, -520.0)], "must be positive"),
        ([(0, 0, 4.2), (1, 1, 4.2)], "in pixels"),
        ([(0, 2, 900e3)], "far outside an image of 640 x 480"),
        ([(1, 2, -5e6)], "far outside an image of 640 x 480"),
    ],
)
def test_what_is_no_calibration_is_named(entries: list[tuple[int, int, float]], said: str) -> None:
    K = GOOD.repeat(3, 1, 1)
    for i, j, value in entries:
        K[1, i, j] = value
    problems = calibration_problems(K, SIZE.expand(3, 2), "K1")
    assert problems[::2] == ("", "")
    assert problems[1].startswith("K1 ")
    assert said in problems[1]
    square = square_pixels(K, SIZE.expand(3, 2), torch.tensor([True, False, True]))
    assert bool(square.map.isfinite().all())
    assert torch.equal(square.map[1], torch.eye(3, dtype=torch.float64))


GENERATOR = torch.Generator().manual_seed(0)
PIXELS = torch.rand(3, 50, 4, generator=GENERATOR, dtype=torch.float64) * torch.tensor([[[900.0]], [[30.0]], [[4e5]]])


def test_matrices_follow_the_points() -> None:
    frame = PixelFrame.around(PIXELS, torch.ones(3, 50, dtype=torch.bool))
    F = torch.randn(3, 2, 3, 3, generator=GENERATOR, dtype=torch.float64)
    x = frame.normalized(PIXELS)

    def errors(matrices: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        x0, x1 = (torch.nn.functional.pad(p, (0, 1), value=1.0) for p in points.split(2, -1))
        return torch.einsum("pni,pkij,pnj->pkn", x1, matrices, x0)

    # Cancellation of terms up to (coordinate / unit)^2, which is below 10: a few hundred eps.
    torch.testing.assert_close(errors(frame.to_pixels(F), PIXELS), errors(F, x), rtol=0, atol=1e-12)
    torch.testing.assert_close(frame.from_pixels(frame.to_pixels(F)), F, rtol=0, atol=1e-12)
