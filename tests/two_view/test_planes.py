"""Homographies of planes in units of their own, seen from either side, and what support means."""

import math

import numpy as np
import pytest
import torch

import fmtorch
from fmtorch.geometry import significance

K = np.array([[900.0, 0, 639.5], [0, 900, 359.5], [0, 0, 1]])


def pitch(seed: int, up: bool, count: int = 60, wrong: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a court in metres, y up or down, where a camera beside it sees them, with 0.5 px of noise; the map."""
    rng = np.random.default_rng(seed)
    court = rng.uniform([0, 0], [28, 15], (count, 2))
    centre = np.array([14.0, -12, 7])
    z = np.array([14.0, 7, 0]) - centre
    R = np.stack([np.array([1.0, 0, 0]), np.cross(z / np.linalg.norm(z), [1.0, 0, 0]), z / np.linalg.norm(z)])
    H = K @ np.c_[R[:, 0], R[:, 1], -R @ centre] @ np.diag([1, 1 if up else -1, 1])
    court = court * [1, 1 if up else -1]
    y = mapped(H, court) + 0.5 * rng.normal(size=(count, 2))
    bad = np.arange(count) < wrong * count
    y[bad] = rng.uniform([0, 0], [1280, 720], (int(bad.sum()), 2))
    return court, y, H


def mapped(H: np.ndarray, x: np.ndarray) -> np.ndarray:
    y = np.c_[x, np.ones(len(x))] @ H.T
    return y[:, :2] / y[:, 2:]


def error(H: torch.Tensor, truth: np.ndarray, court: np.ndarray, unit: np.ndarray) -> float:
    """Root mean square of distances in the photograph."""
    apart = mapped(H.numpy() @ unit, court) - mapped(truth, court)
    return float(np.sqrt((apart**2).sum(1).mean()))


@pytest.mark.parametrize("up", [False, True])
@pytest.mark.parametrize("shift", [0.0, 1e5])
def test_the_unit_of_a_plane_and_its_orientation_change_nothing(up: bool, shift: float) -> None:
    """From kilometres to centimetres, in units of the plane, and on a map far from its origin."""
    for seed in range(3):
        court, y, H = pitch(seed, up)
        for scale in (1e-3, 1 / 28, 1.0, 50.0, 100.0, 1e4):
            unit = np.array([[scale, 0, shift * scale], [0, scale, -3 * shift * scale], [0, 0, 1]])
            e = fmtorch.find_homography(mapped(unit, court), y)
            assert bool(e.ok)
            assert int(e.inliers[0, 18:].sum()) >= 40
            assert error(e.H[0], H, court, unit) < 0.6  # by 8 parameters of 42 matches some 0.3
            assert float(e.significance) > 50
            assert bool(e.related)
            seen = torch.from_numpy(np.c_[mapped(unit, court), np.ones(60)]) @ e.H[0, 2]
            assert bool((seen[e.inliers[0]] > 0).all())


def test_a_mirrored_photograph_is_the_mirror_of_it() -> None:
    """Bits and gradients of the other orientation, in a batch with one that is not mirrored."""
    rng = np.random.default_rng(0)
    x = rng.uniform([0, 0], [640, 480], (80, 2))
    y = mapped(np.array([[0.9, 0.1, 20], [-0.1, 1, 5], [1e-4, 2e-4, 1]]), x) + 0.3 * rng.normal(size=(80, 2))
    flipped = x * [1, -1]
    both = torch.from_numpy(np.stack([x, flipped])).requires_grad_()
    e = fmtorch.find_homography(both, torch.from_numpy(np.stack([y, y])))
    assert e.ok.tolist() == [True, True]
    assert torch.equal(e.H[1], e.H[0] * torch.tensor([1.0, -1, 1]))
    (gradient,) = torch.autograd.grad((e.H[0] * e.H[0].detach().roll(1)).sum(), both, retain_graph=True)
    (turned,) = torch.autograd.grad((e.H[1] * torch.tensor([1.0, -1, 1]) * e.H[0].detach().roll(1)).sum(), both)
    torch.testing.assert_close(turned[1], gradient[0] * torch.tensor([1.0, -1]), rtol=1e-12, atol=1e-15)


def test_matches_of_nothing_have_no_homography() -> None:
    """Any four have one, and of a hundred some agree by chance."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x0, x1 = rng.uniform([0, 0], [640, 480], (2, 100, 2))
        e = fmtorch.find_homography(x0, x1)
        assert not bool(e.ok), seed
        assert "no more than by chance" in e.reason[0]
    exact = fmtorch.find_homography(x0[:4], mapped(np.diag([2.0, 2, 1]), x0[:4]))
    assert (exact.ok.tolist(), exact.related.tolist()) == ([True], [False])


def test_significance_is_that_of_its_definition() -> None:
    """NFA(k) = 2 (n - 4) C(n, k) C(k, 4) p_k^(k - 4), by whole numbers; each match in a cell of its own."""
    rng = np.random.default_rng(4)
    x0 = np.stack(np.meshgrid(np.arange(5) * 120.0, np.arange(4) * 120.0), -1).reshape(-1, 2)
    H = np.array([[1.1, 0.05, 12], [-0.04, 0.98, 7], [2e-5, -3e-5, 1]])
    x1 = mapped(H, x0) + rng.normal(size=(20, 2)) * np.r_[np.full(14, 0.7), np.full(6, 90.0)][:, None]
    back = mapped(np.linalg.inv(H), x1)
    areas = [np.prod(np.ptp(x, axis=0)) for x in (x0, x1)]
    ends = zip((x0, x1), (back, mapped(H, x0)), areas, strict=True)
    chance = np.max([np.pi * ((a - b) ** 2).sum(1) / area for a, b, area in ends], 0)
    p = np.sort(np.clip(chance, 2.0**-26, 1))
    expected = max(
        -math.log10(2 * 16 * math.comb(20, k) * math.comb(k, 4)) - (k - 4) * math.log10(p[k - 1]) for k in range(5, 21)
    )
    got = significance(*(torch.from_numpy(a)[None] for a in (H, x0, x1)), model="homography")
    assert float(got) == pytest.approx(expected, rel=1e-9)
