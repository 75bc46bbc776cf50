"""Corner errors and right matches of homographies, against the definition written out."""

import numpy as np
import pytest
import torch

from fmtorch.metrics import corner_error, right_of_homography

SIZE = torch.tensor([480, 640])


def mapped(H: np.ndarray, point: tuple[float, float]) -> np.ndarray:
    x, y, w = H @ [*point, 1.0]
    return np.array([x / w, y / w])


def written_out(H: np.ndarray, true: np.ndarray, h: int, w: int) -> float:
    corners = [(0, 0), (w - 1, 0), (w - 1, h - 1), (0, h - 1)]
    return float(np.mean([np.linalg.norm(mapped(H, c) - mapped(true, c)) for c in corners]))


def homographies(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.eye(3) + rng.uniform(-1, 1, (count, 3, 3)) * [[0.1, 0.1, 30], [0.1, 0.1, 30], [2e-4, 2e-4, 0]]


def test_corner_error_is_the_mean_over_four_corners() -> None:
    H, true = homographies(20), homographies(40)[20:]
    errors = corner_error(torch.from_numpy(H), torch.from_numpy(true), SIZE)
    expected = [written_out(a, b, 480, 640) for a, b in zip(H, true, strict=True)]
    np.testing.assert_allclose(errors, expected, rtol=1e-9)
    scaled = corner_error(-7 * torch.from_numpy(H), torch.from_numpy(true), SIZE)
    torch.testing.assert_close(scaled, errors)
    alone = torch.stack(
        [corner_error(torch.from_numpy(a), torch.from_numpy(b), SIZE) for a, b in zip(H, true, strict=True)]
    )
    assert torch.equal(alone, errors)


def test_corner_error_of_what_has_no_image_is_infinite() -> None:
    horizon = torch.eye(3, dtype=torch.float64)
    horizon[2] = torch.tensor([1.0, 0, -639])  # zero at the right corners
    for H in (horizon, torch.zeros(3, 3), torch.full((3, 3), torch.nan)):
        assert corner_error(H, torch.eye(3), SIZE) == torch.inf
    with pytest.raises(ValueError, match="size0"):
        corner_error(torch.eye(3), torch.eye(3), torch.tensor([0, 640]))


def test_corner_error_has_gradients() -> None:
    H = torch.from_numpy(homographies(3)).requires_grad_()
    true = torch.from_numpy(homographies(6)[3:])
    assert torch.autograd.gradcheck(lambda x: corner_error(x, true, SIZE), H)
    corner_error(H, H.detach(), SIZE).sum().backward()  # at zero
    assert torch.isfinite(H.grad).all()


def test_right_matches_are_near_in_both_images() -> None:
    true = homographies(1)[0]
    x0 = np.random.default_rng(1).uniform(0, 400, (50, 2))
    x1 = np.array([mapped(true, (x, y)) for x, y in x0]) + np.random.default_rng(2).normal(0, 3, (50, 2))
    back = np.array([mapped(np.linalg.inv(true), (x, y)) for x, y in x1])
    forth = np.array([mapped(true, (x, y)) for x, y in x0])
    distance = (np.linalg.norm(back - x0, axis=1) + np.linalg.norm(forth - x1, axis=1)) / 2
    ends = (torch.from_numpy(x) for x in (x0, x1))
    right = right_of_homography(torch.from_numpy(true), *ends, mask=torch.arange(50) < 40)
    np.testing.assert_array_equal(right, (distance < 3) & (np.arange(50) < 40))
    assert 5 < int(right.sum()) < 40
