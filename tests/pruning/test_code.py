import numpy as np
import pytest
import torch
from torch import Tensor

from fmtorch.core import Correspondences
from fmtorch.pruning.code import huber_regression, match_domain, predictive_gaussians, spread_centres
from tests.reference import code as reference

WIDTHS = {"position": 0.5, "displacement": 0.2, "rotation": 0.8, "scale": 0.5}


def frames(x: np.ndarray, S: np.ndarray) -> np.ndarray:
    return np.concatenate([S, x[:, :, None]], 2)


def turn(angle: np.ndarray, scale: np.ndarray) -> np.ndarray:
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def warped(seed: int, n: int, outliers: float, noise: float = 0.5) -> tuple[Correspondences, Tensor]:
    """Matches that follow a turn by 0.6, a zoom by 1.3 and a bend; outliers anywhere. And which are right."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(0, 800, (n, 2))
    A = turn(np.array(0.6), np.array(1.3))
    bend = 4e-4 * np.stack([np.square(x0[:, 1] - 400), (x0[:, 0] - 400) * (x0[:, 1] - 400)], 1)
    x1 = x0 @ A.T + bend + (100, -50) + rng.normal(0, noise, (n, 2))
    J = np.zeros((n, 2, 2))
    J[:, 0, 1], J[:, 1, 0], J[:, 1, 1] = 8e-4 * (x0[:, 1] - 400), 4e-4 * (x0[:, 1] - 400), 4e-4 * (x0[:, 0] - 400)
    S0 = turn(rng.uniform(-np.pi, np.pi, n), rng.uniform(10, 40, n))
    S1 = turn(rng.normal(0, 0.1, n), np.exp(rng.normal(0, 0.1, n))) @ (A + J) @ S0
    wrong = rng.random(n) < outliers
    x1[wrong] = rng.uniform(x1.min(0), x1.max(0), (int(wrong.sum()), 2))
    S1[wrong] = turn(rng.uniform(-np.pi, np.pi, n), rng.uniform(10, 40, n))[wrong]
    ratio = np.where(wrong, rng.uniform(0.7, 1, n), rng.uniform(0.4, 1, n))

    def tensor(value: np.ndarray) -> Tensor:
        return torch.from_numpy(value.astype(np.float32))[None]

    c = Correspondences(
        tensor(x0), tensor(x1), torch.ones(1, n, dtype=torch.bool), ratio=tensor(ratio),
        lafs0=tensor(frames(x0, S0)), lafs1=tensor(frames(x1, S1)),
    )  # fmt: skip
    return c, torch.from_numpy(~wrong)


def domain_of(c: Correspondences) -> tuple:
    x0, x1, lafs0, lafs1 = (v[0].double().numpy() for v in (c.x0, c.x1, c.lafs0, c.lafs1))
    (p0, s0), (p1, s1) = reference.normalised(x0), reference.normalised(x1)
    S = [b[:, :2] @ np.linalg.inv(a[:, :2]) * s0 / s1 for a, b in zip(lafs0, lafs1, strict=True)]
    return match_domain(c.x0[0], c.x1[0], c.lafs0[0], c.lafs1[0]), list(zip(p0, p1, S, strict=True))


def test_gaussians_equal_the_definition() -> None:
    ours, theirs = domain_of(warped(0, 40, 0.3)[0])
    computed = predictive_gaussians(ours, ours.take(torch.arange(0, 40, 3)), **WIDTHS)
    expected = [[reference.predictive_gaussian(a, b, WIDTHS) for b in theirs[::3]] for a in theirs]
    # Exponents are differences of float32 terms up to about 100: 100 * 2^-23 = 1e-5.
    np.testing.assert_allclose(computed, expected, atol=1e-4)


def test_centres_equal_the_definition_and_go_where_matches_crowd() -> None:
    c, right = warped(1, 60, 0.5)
    ours, _ = domain_of(c)
    kernel = predictive_gaussians(ours, ours, **WIDTHS).double()
    chosen = spread_centres(kernel, 12).tolist()
    assert chosen == reference.spread_centres(kernel.numpy(), 12)
    assert right[chosen[:6]].all()


@pytest.mark.parametrize("columns", [1, 2])
def test_regression_finds_the_minimum(columns: int) -> None:
    rng = np.random.default_rng(2)
    basis = rng.normal(size=(60, 5))
    target = basis @ rng.normal(size=(5, columns)) + 0.05 * rng.normal(size=(60, columns))
    target[::4] += rng.normal(size=(15, columns)) * 5
    ridge = np.diag(rng.uniform(0.1, 2, 5))
    expected = reference.huber_regression(basis, target, ridge, 0.1)
    fitted = huber_regression(*(torch.from_numpy(v) for v in (basis, target, ridge)), scale=0.1, iterations=200)
    np.testing.assert_allclose(fitted, expected, atol=1e-4)  # where the optimiser stops: its gradient is below 1e-5
