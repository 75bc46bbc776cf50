"""Homographies, their Sampson error and its minimum, and those of four matches, equal their definitions."""

import itertools
from typing import NamedTuple

import numpy as np
import pytest
import torch

from fmtorch import geometry
from fmtorch.geometry import homography_refine
from fmtorch.geometry.epipolar import HOMOGRAPHY
from fmtorch.geometry.homography import four_point
from fmtorch.geometry.levenberg_marquardt import Schedule, Weighted
from tests.reference import homography as reference
from tests.reference.homography import mapped, sampson_squared

PX = 400.0  # of a unit of the points
EPS = 2.0**-52
KINDS = ("cauchy", "geman_mcclure", "huber", "truncated")
ROUNDING32, ROUNDING64 = 2.0**-24, 2.0**-53


def planar(seed: int, n: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Matches (4, n) of about unit scale on a plane, and their homography."""
    rng = np.random.default_rng([seed, n])
    H = np.eye(3) + rng.uniform(-0.3, 0.3, (3, 3))
    x0 = rng.uniform(-1, 1, (n, 2))
    return np.ascontiguousarray(np.c_[x0, mapped(H, x0) + noise * rng.normal(size=x0.shape)].T), H


def pairs(batch: tuple[int, ...], n: int, noise: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Matches (*batch, n, 2) in pixels on a plane of their own each, and the homographies (*batch, 3, 3)."""
    x, truth = np.empty((*batch, 4, n)), np.empty((*batch, 3, 3))
    for k, i in enumerate(np.ndindex(batch)):
        points, H = planar(k, n, noise)
        to_pixels = np.array([[PX, 0, PX], [0, PX, PX], [0, 0, 1]])
        x[i], truth[i] = points * PX + PX, to_pixels @ H @ np.linalg.inv(to_pixels)
    x0, x1 = (torch.from_numpy(x[..., k : k + 2, :]).mT.contiguous() for k in (0, 2))
    return x0, x1, torch.from_numpy(truth)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("n", [4, 5, 50])
def test_least_squares(batch: tuple[int, ...], n: int) -> None:
    x0, x1, truth = pairs(batch, n, noise=0.005 if n > 4 else 0.0)
    w = torch.rand(*batch, n, dtype=torch.float64) + 0.1
    for weight in (None, w):
        H, valid = geometry.homography(x0, x1, weight)
        assert valid.shape == batch
        assert bool(valid.all())
        for i in np.ndindex(batch):
            expected = reference.dlt(x0[i].numpy(), x1[i].numpy(), None if weight is None else weight[i].numpy())
            there = mapped(expected, x0[i].numpy())
            # M squares the condition of the equations, some 30 here: 1e-16 * 1e3 in units, of 400 px.
            np.testing.assert_allclose(geometry.homography_points(H[i], x0[i]).numpy(), there, atol=1e-8)
    if n == 4:
        H = geometry.homography(x0, x1)[0]
        assert bool((geometry.homography_transfer(H, x0, x1)[1] < 1e-8).all())
        assert bool((geometry.homography_points(H, x0) - geometry.homography_points(truth, x0)).abs().max() < 1e-8)
    depth = (torch.cat([x0, torch.ones_like(x0[..., :1])], -1) @ H[..., 2, :, None])[..., 0]
    assert bool((depth > 0).all())


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_degenerate_matches(scale: float) -> None:
    x0, x1, _ = pairs((), 6)
    x0, x1 = x0 * scale, x1 * scale
    assert bool(geometry.homography(x0, x1)[1])
    along = torch.linspace(0, 1, 6, dtype=torch.float64)[:, None]
    on_line = x0[:1] * along + x0[1:2] * (1 - along)
    on_line1 = x1[:1] * along + x1[1:2] * (1 - along)
    one_off = torch.cat([on_line[:5], x0[2:3]]), torch.cat([on_line1[:5], x1[2:3]])
    cases = {
        "three matches": (x0[:3], x1[:3]), "none": (x0[:0], x1[:0]), "one line": (on_line, on_line1),
        "one point off a line": one_off, "coincident": (x0[:1].expand(6, 2), x1[:1].expand(6, 2)),
        "three different": (x0[[0, 1, 2, 2, 1, 0]], x1[[0, 1, 2, 2, 1, 0]]),
        "a plane to a point": (x0, x1[:1].expand(6, 2)),
        "not finite": (x0.index_fill(0, torch.tensor([2]), torch.inf), x1),
    }  # fmt: skip
    for name, (a, b) in cases.items():
        H, valid = geometry.homography(a.requires_grad_(), b)
        assert not bool(valid), name
        assert bool((H == 0).all()), name
        if len(a):
            H.sum().backward()
            assert a.grad is None or bool(torch.isfinite(a.grad).all()), name
    assert not bool(geometry.homography(x0, x1, -torch.ones(6, dtype=torch.float64))[1])


def test_distances() -> None:
    x0, x1, H = pairs((3,), 20, noise=0.05)
    d0, d1 = geometry.homography_transfer(H, x0, x1)
    sampson = geometry.homography_sampson(H, x0, x1)
    for i in range(3):
        a, b, h = x0[i].numpy(), x1[i].numpy(), H[i].numpy()
        np.testing.assert_allclose(torch.maximum(d0, d1)[i].numpy(), reference.transfer(h, a, b), rtol=1e-9)
        np.testing.assert_allclose(d1[i].numpy(), np.linalg.norm(mapped(h, a) - b, axis=1), rtol=1e-9)
        expected = [np.sqrt(sampson_squared(h, np.append(p, q))) for p, q in zip(a, b, strict=True)]
        np.testing.assert_allclose(sampson[i].numpy(), expected, rtol=1e-8)
    for factor in (-1.0, 1e-200, 1e200):  # of any scale and sign
        for ours, scaled in zip((d0, d1), geometry.homography_transfer(H * factor, x0, x1), strict=True):
            torch.testing.assert_close(scaled, ours, rtol=1e-9, atol=0)
        torch.testing.assert_close(geometry.homography_sampson(H * factor, x0, x1), sampson, rtol=1e-9, atol=0)
    assert torch.equal(geometry.homography_sampson(H, x0[:1], x1)[0], sampson[0])  # leading dimensions broadcast
    far = [points.float() * 1e9 for points in (x0, x1)]  # powers of which float32 does not hold
    exact = geometry.homography_sampson(H.float().double(), *(points.double() for points in far))
    assert torch.equal(geometry.homography_sampson(H.float(), *far), exact.float())
    assert bool(geometry.homography_sampson(H.float(), *far).isfinite().all())


def test_horizons_are_infinitely_far() -> None:
    H = torch.tensor([[1.0, 0, 0], [0, 1, 0], [1, 0, 0]], requires_grad=True)  # its horizon is x = 0; singular
    x0, x1 = torch.tensor([[0.0, 3.0], [2.0, 3.0]]), torch.tensor([[1.0, 1.0], [1.0, 1.5]])
    d0, d1 = geometry.homography_transfer(H, x0, x1)
    assert torch.equal(d1.detach(), torch.tensor([torch.inf, 0.0]))
    assert bool(torch.isinf(geometry.homography_points(H, x0)[0]).all())
    torch.where(torch.isfinite(d0), d0, 0).sum().backward(retain_graph=True)
    torch.where(torch.isfinite(d1), d1, 0).sum().backward()
    assert bool(torch.isfinite(H.grad).all())


def test_gradients() -> None:
    x0, x1, H = pairs((1,), 7, noise=0.01)
    x0, x1 = x0 / PX, x1 / PX
    D = torch.diag(torch.tensor([PX, PX, 1.0], dtype=torch.float64))
    H = torch.linalg.inv(D) @ H @ D
    weight = torch.rand(1, 7, dtype=torch.float64) + 0.1
    for tensor in (x0, x1, H, weight):
        tensor.requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b, w: geometry.homography(a, b, w)[0], (x0, x1, weight))
    assert torch.autograd.gradcheck(lambda a, b: geometry.homography(a, b)[0], (x0[:, :4], x1[:, :4]))
    for distance in (geometry.homography_transfer, geometry.homography_sampson):
        assert torch.autograd.gradcheck(distance, (H, x0, x1))
    assert torch.autograd.gradcheck(geometry.homography_points, (H, x0))
    exact = geometry.homography_points(H.detach(), x0)
    (gradient,) = torch.autograd.grad(geometry.homography_sampson(H, x0, exact).sum(), x0)
    assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("loss", ["truncated", "cauchy", "geman_mcclure", "huber", "magsac"])
def test_gradients_of_refined_homographies_are_those_of_the_optimum(loss: str) -> None:
    x0, x1, truth = pairs((2,), 25, noise=0.003)  # 1.2 px
    x1[:, 0] += 30  # a wrong match
    weight = torch.rand(2, 25, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 0.1
    inputs = [x0.requires_grad_(), x1.requires_grad_(), weight.requires_grad_()]
    scale = torch.tensor([8.0, 12.0], dtype=torch.float64)
    corners = torch.tensor([[0.0, 0.0], [800.0, 0.0], [800.0, 800.0], [0.0, 800.0]], dtype=torch.float64)

    def seen(a: torch.Tensor, b: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        H = geometry.refine_homography(truth, a, b, w, loss=loss, scale=scale, iterations=60)
        return geometry.homography_points(H, corners).sum((-2, -1))

    value = seen(*inputs)
    generator = torch.Generator().manual_seed(1)
    for k, (of, step) in enumerate(zip(inputs, (1e-3, 1e-3, 1e-4), strict=True)):
        gradients = torch.autograd.grad(value.sum(), of, retain_graph=True)[0]
        for _ in range(3):
            along = torch.randn(of.shape, dtype=torch.float64, generator=generator)
            ends = []
            for sign in (1, -1):
                moved = [t.detach().clone() for t in inputs]
                moved[k] += sign * step * along
                ends.append(seen(*moved))
            slope = (ends[0] - ends[1]) / (2 * step)
            expected = (gradients * along).flatten(1).sum(1)
            torch.testing.assert_close(slope, expected, rtol=2e-3, atol=1e-3 * float(gradients.norm()))


def test_refined_homographies() -> None:
    x0, x1, truth = pairs((2,), 40, noise=0.003)
    many = torch.stack([truth, -3 * truth, torch.zeros_like(truth), torch.full_like(truth, torch.nan)], 1)
    options = {"loss": "cauchy", "scale": 3.0, "iterations": 20}
    refined = geometry.refine_homography(many, x0, x1, **options)
    assert refined.shape == many.shape
    assert torch.equal(refined[:, 0], geometry.refine_homography(truth, x0, x1, **options))
    torch.testing.assert_close(refined[:, 0], refined[:, 1], rtol=0, atol=1e-9)
    assert not bool(torch.isfinite(refined[:, 2:]).all(-1).any())
    costs = [(1 + geometry.homography_sampson(H, x0, x1).square() / 9).log().sum(-1) for H in (truth, refined[:, 0])]
    assert bool((costs[1] < costs[0]).all())
    x0.requires_grad_()
    attached = geometry.refine_homography(many, x0, x1, **options)
    assert torch.equal(attached.detach().nan_to_num(7), refined.nan_to_num(7))
    attached[:, :2].sum().backward()
    assert bool(torch.isfinite(x0.grad).all())
    with pytest.raises(ValueError, match="welsch"):
        geometry.refine_homography(truth, x0, x1, loss="welsch")


class Problem(NamedTuple):
    """A model (9,) of unit norm, noisy matches (4, n) of it, weights (n,) and squared scales (n,)."""

    h: np.ndarray
    points: np.ndarray
    weight: np.ndarray
    s2: np.ndarray

    def weighted(self, loss: str) -> Weighted:
        return Weighted.of(self.points, self.weight, self.s2, loss)


def problem(seed: int, n: int = 30, noise: float = 0.02) -> Problem:
    """The first two matches have no weight, the third is wrong."""
    rng = np.random.default_rng(seed)
    h = (np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))).ravel()
    x0 = rng.uniform(-1, 1, (n, 2))
    points = np.ascontiguousarray(np.c_[x0, reference.mapped(h, x0)].T) + noise * rng.normal(size=(4, n))
    points[2:, 2] = rng.uniform(-1, 1, 2)
    weight, s2 = rng.uniform(0.2, 1, n), (noise * rng.uniform(0.8, 3, n)) ** 2
    weight[:2] = 0
    return Problem(h / np.linalg.norm(h), points, weight, s2)


def evaluated(h: np.ndarray, matches: Weighted) -> tuple[np.ndarray, float]:
    products, cost = np.empty((1, 10, 10)), np.empty(1)
    homography_refine.evaluate_homographies(h[None].copy(), matches, True, products, cost)
    return products[0], float(cost[0])


def behind(each: Problem) -> Problem:
    """The same with the fourth match on the other side of the horizon, far from its weight on this one."""
    points = each.points.copy()
    points[:2, 3] = -2 * each.h[6:8] / (each.h[6:8] @ each.h[6:8]) * each.h[8]
    return each._replace(points=points)


def test_the_error_in_kernels_equals_its_definition() -> None:
    for seed in range(20):
        p = behind(problem(seed))
        expected = np.array([reference.sampson_squared(p.h, match) for match in p.points.T])
        assert np.flatnonzero(np.isinf(expected)).tolist() == [3]
        computed = [HOMOGRAPHY.of_match(p.h, *match) for match in p.points.T]
        # e cancels from terms of about 1, so r is exact to a few dozen roundings; r^2 to 2 r of these.
        atol = 100 * EPS * np.sqrt(expected.min()) + 1e4 * EPS**2
        np.testing.assert_allclose(computed, expected, rtol=1e-11, atol=atol)


@pytest.mark.parametrize("loss", KINDS)
def test_cost_and_gradient(loss: str) -> None:
    for seed in range(5):
        p = problem(seed)

        def cost(h: np.ndarray, p: Problem = p) -> complex:
            return reference.robust_sum(h, p.points, p.weight, p.s2, loss)

        products, computed = evaluated(p.h, p.weighted(loss))
        # Sums of 30 terms, each exact to 100 roundings over a residual of 1e-3 of coordinates of 1.
        assert computed == pytest.approx(float(np.real(cost(p.h))), rel=1e-10)
        slope = reference.gradient(cost, p.h)
        np.testing.assert_allclose(2 * products[9, :9], slope, atol=1e-10 * np.abs(slope).max())
        assert abs(products[9, :9] @ p.h) < 1e-10 * np.abs(slope).max()  # the scale of H counts nothing


@pytest.mark.parametrize("loss", KINDS)
def test_refinement_ends_where_the_gradient_vanishes(loss: str) -> None:
    for seed in range(5):
        p = problem(seed, n=60)
        rng = np.random.default_rng(seed)
        start = p.h + 0.005 * rng.normal(size=(2, 9))
        out, cost = np.empty((2, 9)), np.empty(2)
        homography_refine.refine_homographies(start, p.weighted(loss), Schedule(100, 1e-4, 0.0), out, cost)
        for h, before, after in zip(out, start, cost, strict=True):
            assert np.linalg.norm(h) == pytest.approx(1, abs=4 * EPS)
            assert after == pytest.approx(reference.robust_sum(h, p.points, p.weight, p.s2, loss).real, rel=1e-10)
            assert after <= reference.robust_sum(before, p.points, p.weight, p.s2, loss).real
            products, _ = evaluated(h, p.weighted(loss))
            # A step is refused once it lowers the cost by less than its rounding, EPS: gradients of sqrt(EPS) stay.
            size = np.sqrt(np.diagonal(products)[:9] * after)
            assert (np.abs(products[9, :9]) <= 1e-6 * size).all()


def solved(points: np.ndarray, sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H (m, 9) and draw (m,) of samples (4, s)."""
    H, draw = np.full((sample.shape[1], 9), np.nan, np.float32), np.full(sample.shape[1], -1)
    count = four_point(points, sample, H, draw)
    assert np.isnan(H[count:]).all()
    return H[:count], draw[:count]


def alone(match: np.ndarray) -> np.ndarray:
    """The models of one sample, its matches (4, 4) in columns."""
    return solved(np.ascontiguousarray(match), np.arange(4)[:, None])[0]


def quadrilateral(seed: int, kind: str = "seen") -> np.ndarray:
    """Matches (4, 4) of a plane that is seen, or of nothing."""
    return planar(seed, 4)[0] if kind == "seen" else np.random.default_rng(seed).uniform(-1, 1, (4, 4))


@pytest.mark.parametrize("kind", ["seen", "random"])
def test_samples_equal_the_dlt(kind: str) -> None:
    count = 300
    points = np.hstack([quadrilateral(seed, kind) for seed in range(count)])
    sample = np.arange(4 * count).reshape(count, 4).T.copy()
    H, draw = solved(points, sample)
    assert (np.diff(draw) > 0).all()
    expected = [reference.four_points(points[:, i]) for i in sample.T]
    assert draw.tolist() == [i for i, (h, _) in enumerate(expected) if h is not None]
    assert 10 < len(draw) < count or kind == "seen"
    for h, i in zip(H, draw, strict=True):
        truth, condition = expected[i]
        # A rounding to float32, and 64 in float64 (9 entries of 3 products, the equations' own) times the condition.
        np.testing.assert_allclose(h, truth, atol=ROUNDING32 + 64 * ROUNDING64 * condition)


@pytest.mark.parametrize("image", [0, 1])
@pytest.mark.parametrize("three", list(itertools.combinations(range(4), 3)))
def test_three_points_on_a_line_and_coincident_ones_give_no_model(three: tuple[int, int, int], image: int) -> None:
    for seed in range(20):
        for share in (np.random.default_rng(seed).uniform(-2, 2), 0.0, 1.0):
            match = quadrilateral(seed)
            a, b, c = (match[2 * image : 2 * image + 2, k] for k in three)
            c[:] = a + share * (b - a)  # to rounding
            assert len(alone(match)) == 0


def test_a_mirrored_plane_gives_no_model() -> None:
    for seed in range(20):
        match = quadrilateral(seed)
        assert len(alone(match)) == 1
        match[2] *= -1
        assert len(alone(match)) == 0


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_points_of_any_unit(scale: float) -> None:
    for seed in range(20):
        match = quadrilateral(seed)
        h, D = reference.four_points(match)[0], np.diag([scale, scale, 1])
        expected = D @ h.reshape(3, 3) @ np.linalg.inv(D)
        (H,) = alone(match * scale)
        np.testing.assert_allclose(H, expected.ravel() / np.linalg.norm(expected), atol=2 * ROUNDING32)
        match[2:, 3] = (match[2:, 0] + 2 * match[2:, 1]) / 3
        assert len(alone(match * scale)) == 0
