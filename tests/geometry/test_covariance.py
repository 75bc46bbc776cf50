"""The covariance of a two-view estimate: the reference, derivatives, what is not determined, laws, simulated noise."""

import math

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch import Tensor

from fmtorch.geometry import pose_from_fundamental, two_view_covariance
from fmtorch.geometry.covariance import LensesInPixels, noise_inflation
from tests.geometry.scenes import scene
from tests.reference import lenses as division
from tests.reference import two_view as reference
from tests.reference.two_view import Cameras

INF = math.inf
PRECISIONS = {
    "unknown": [[4.0, 0], [0, 9]],
    "correlated": [[6.0, -4], [-4, 6]],
    "shared": [[3.0, 0], [0, 3]],
    "first known": [[INF, 0], [0, 5]],
    "second known": [[5.0, 0], [0, INF]],
    "both known": [[INF, 0], [0, INF]],
    "shared and known": [[INF, 0], [0, 0]],
}


def problem(seed: int, n: int = 60, noise: float = 0.5) -> tuple[Cameras, np.ndarray, np.ndarray]:
    """Cameras with square pixels near those that have noisy matches (n, 2), in pixels."""
    s = scene(n, seed, noise)
    rng = np.random.default_rng(seed)
    principal = np.array([[500.0, 400], [520, 380]])
    cameras = Cameras.of(s.R.numpy(), s.t.numpy(), np.array([910.0, 1090.0]), principal)
    return cameras.moved(1e-4 * rng.normal(size=7)), s.x0.numpy(), s.x1.numpy()


def arguments(*cameras: Cameras) -> dict[str, Tensor]:
    values = {name: np.stack([getattr(c, name) for c in cameras]) for name in ("R", "t", "focal", "principal")}
    values["principal0"], values["principal1"] = values.pop("principal").swapaxes(0, 1)
    return {name: torch.from_numpy(value) for name, value in values.items()}


def batch(sizes: tuple[int, ...], noise: float = 0.5) -> dict[str, Tensor]:
    """Pairs of different numbers of matches, with weights and noise, padded by what is not a number."""
    problems = [problem(i, n, noise) for i, n in enumerate(sizes)]
    longest, rng = max(sizes), np.random.default_rng(0)

    def padded(values: list[np.ndarray]) -> Tensor:
        filled = np.full((len(values), longest, *values[0].shape[1:]), np.nan)
        for row, value in zip(filled, values, strict=True):
            row[: len(value)] = value
        return torch.from_numpy(filled)

    return arguments(*(m[0] for m in problems)) | {
        "x0": padded([m[1] for m in problems]), "x1": padded([m[2] for m in problems]),
        "weight": padded([rng.uniform(0.2, 1, n) for n in sizes]),
        "noise": padded([rng.uniform(0.5, 2, n) for n in sizes]),
        "mask": torch.arange(longest) < torch.tensor(sizes)[:, None],
        "truncation": torch.full((len(sizes),), 4.0, dtype=torch.float64),
        "focal_precision": torch.diag_embed(torch.tensor([[4.0, 4.0]] * len(sizes), dtype=torch.float64)),
        "shared_focal": torch.arange(len(sizes)) % 2 == 1,
    }  # fmt: skip


@pytest.mark.parametrize("kind", PRECISIONS)
def test_against_the_definitions(kind: str) -> None:
    precision, shared = np.array(PRECISIONS[kind]), "shared" in kind
    given = batch((40, 60, 90)) | {"focal_precision": torch.from_numpy(precision).expand(3, 2, 2)}
    given["shared_focal"] = torch.tensor([shared]).expand(3)
    result = two_view_covariance(**given)
    finite = np.where(np.isinf(precision), 0, precision)
    basis = reference.directions(np.isinf(np.diag(precision)), shared)
    for i, n in enumerate((40, 60, 90)):
        cameras = problem(i, n)[0]
        x0, x1, w, noise = (given[name][i, :n].numpy() for name in ("x0", "x1", "weight", "noise"))
        C, V, s = reference.covariance(cameras, x0, x1, w, noise, 4.0, finite, basis)
        turn = np.eye(7)  # tangents are any basis of a plane
        turn[3:5, 3:5] = result.tangent[i].numpy().T @ cameras.basis
        expected = turn @ C @ turn.T
        size = np.outer(*[np.sqrt(np.diag(expected)) + 1e-12] * 2)
        # Central differences of step 1e-6 are good to 1e-9 or so, and the noise ends within a quarter to the tenth.
        np.testing.assert_allclose(result.noise[i], s, rtol=1e-5)
        np.testing.assert_allclose(result.covariance[i].numpy() / size, expected / size, atol=3e-5)
        np.testing.assert_allclose(result.fundamental[i].numpy(), V, atol=3e-5 * V.max())
        known = np.isinf(np.diag(precision)) | (shared and np.isinf(precision).any())
        assert not bool(result.covariance[i][5:][known].any())
    degrees = torch.rad2deg(result.covariance.diagonal(dim1=1, dim2=2)[:, :5].split([3, 2], 1)[0].sum(1).sqrt())
    torch.testing.assert_close(result.deviation_degrees[:, 0], degrees)


@pytest.mark.parametrize("shared", [False, True])
def test_lenses_against_differences(shared: bool) -> None:
    """Of Sampson distances in photographs, by all nine parameters; with a noise that is nothing beside the parallax."""
    lens, size = (-0.15, -0.15 if shared else -0.05), (480, 640)
    x0, x1, F, K = division.photographs(1, lens, noise=0.05, wrong=0)
    x0, x1 = x0[::4], x1[::4]
    straight = [np.array([division.straight(x, size, own) for x in a]) for a, own in zip((x0, x1), lens, strict=True)]
    pose = pose_from_fundamental(*map(torch.from_numpy, (F, K, K, *straight)))
    centre, half = division.frame(size)
    cameras = Cameras.of(pose.R.numpy(), pose.t.numpy(), np.array([K[0, 0]] * 2), np.stack([centre, centre]))
    open_lens = torch.full((1, 2), 0.15**-2)
    result = two_view_covariance(
        torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], **arguments(cameras), truncation=torch.tensor([INF]),
        focal_precision=torch.diag_embed(torch.tensor([[4.0, 9.0]])),
        lens=LensesInPixels(torch.tensor([lens]), torch.full((1, 2), half), open_lens, torch.tensor([shared])),
    )  # fmt: skip

    def distances(by: np.ndarray) -> np.ndarray:
        moved, bent = cameras.moved(by[:7]).fundamental(), (lens[0] + by[7], lens[1] + by[7 if shared else 8])
        return np.array([division.sampson(moved, x, (size, size), bent) for x in np.c_[x0, x1]])

    step, used = 1e-4, 8 if shared else 9
    J = np.stack([(distances(d) - distances(-d)) / (2 * step) for d in step * np.eye(9)[:used]], 1)
    variance = float(result.noise) ** 2 * reference.inflation(x0, distances(np.zeros(9)))
    C = np.linalg.inv(J.T @ J / variance + np.diag([0.0] * 5 + [4, 9] + [0.15**-2] * (used - 7)))
    own = result.covariance[0].numpy()
    np.testing.assert_allclose(own.diagonal()[5:used], C.diagonal()[5:], rtol=0.01)
    np.testing.assert_allclose(own[7, 5], C[7, 5], rtol=0.01)
    assert np.trace(own[:3, :3]) == pytest.approx(np.trace(C[:3, :3]), rel=0.01)
    assert np.trace(own[3:5, 3:5]) == pytest.approx(np.trace(C[3:5, 3:5]), rel=0.01)
    np.testing.assert_array_equal(own[8], own[7] if shared else own[:, 8])


def test_cameras_that_are_none_and_what_matches_leave_open_are_uncertain() -> None:
    given = batch((50,) * 9)
    bad = {k: v.clone() for k, v in given.items()}
    bad["R"][0, 0, 0], bad["t"][1], bad["focal"][2, 1], bad["truncation"][3] = torch.nan, 0, -3, 0
    bad["focal_precision"][4] = torch.tensor([[1.0, torch.nan], [torch.nan, 1.0]])
    bad["mask"][5], bad["x0"][6], bad["x1"][6] = False, 7.0, 9.0
    bad["focal_precision"][7] = torch.tensor([[-1e9, 0.0], [0.0, -1e9]])  # a prior that is no maximum adds nothing
    result = two_view_covariance(**bad)
    assert result.valid.tolist() == [False] * 5 + [True] * 4
    for value in result:
        assert not bool(value.isnan().any())
    empty = two_view_covariance(**{name: value[:0] for name, value in given.items()})
    assert empty.covariance.shape == (0, 7, 7)
    nothing_known = torch.tensor([math.degrees(1.33 * 3**0.5), math.degrees(1.21 * 2**0.5)], dtype=torch.float64)
    torch.testing.assert_close(result.deviation_degrees[:6], nothing_known.expand(6, 2))
    assert bool((result.deviation_degrees[6] > 60).all())
    assert bool((result.covariance.diagonal(dim1=1, dim2=2) >= 0).all())


def test_what_is_not_determined_is_uncertain() -> None:
    """A camera that turns has no direction of translation, one that moves along its axis no focal length."""
    rng = np.random.default_rng(0)
    X = np.c_[rng.uniform(-2, 2, (300, 2)), rng.uniform(4, 8, 300)]
    principal = np.array([[500.0, 400], [500, 400]])

    def deviations(R: np.ndarray, t: np.ndarray, precision: np.ndarray) -> tuple[Tensor, Tensor]:
        Y = X @ R.T + t
        x0, x1 = (900 * Z[:, :2] / Z[:, 2:] + principal[0] + rng.normal(0, 0.5, (300, 2)) for Z in (X, Y))
        assumed = Cameras.of(R, t if t.any() else np.array([1.0, 0, 0]), np.array([900.0, 900]), principal)
        result = two_view_covariance(
            torch.from_numpy(x0)[None], torch.from_numpy(x1)[None], **arguments(assumed),
            truncation=torch.tensor([1.5]), focal_precision=torch.from_numpy(precision)[None],
        )  # fmt: skip
        return result.deviation_degrees[0], result.covariance[0].diagonal()[5:].sqrt()

    turned = reference.Rotation.from_rotvec([0.05, 0.2, 0.02]).as_matrix()
    known = np.diag([INF, INF])
    assert float(deviations(turned, np.zeros(3), known)[0][1]) > 20
    assert float(deviations(turned, np.array([1.0, 0.1, 0]), known)[0][1]) < 1
    prior = np.diag([6.25, 6.25])  # of a deviation of 0.4
    along = deviations(np.eye(3), np.array([0, 0, 1.0]), prior)[1]
    across = deviations(turned, np.array([1.0, 0.1, 0.3]), prior)[1]
    assert bool((along > 0.2).all())
    assert bool((across < 0.1).all())


@pytest.mark.parametrize(("width", "apart"), [(0, 6), (4, 6), (8, 6), (8, 3), (16, 6)])
def test_errors_that_neighbours_share(width: float, apart: int) -> None:
    """White noise smoothed by a Gaussian, on a grid: the sum of its correlations is 4 pi width^2 / apart^2."""
    y, x = np.mgrid[0:768:apart, 0:1024:apart].reshape(2, -1)
    inflation, out = [], np.empty(1)
    for seed in range(12):
        field = np.random.default_rng(seed).normal(size=(768, 1024))
        error = (scipy.ndimage.gaussian_filter(field, width, mode="wrap") if width else field)[y, x]
        noise_inflation(np.stack([x, y], 1).astype(float), error, out)
        inflation.append(out[0])
        if apart == 6 and seed == 0:
            near = np.hypot(x, y) < 500
            noise_inflation(np.stack([x, y], 1).astype(float), np.where(near, error, 0), out)
            assert out[0] == pytest.approx(reference.inflation(np.stack([x, y], 1)[near], error[near]), rel=1e-9)
    # A tenth of shared errors is missed, an inflation is at least 1; that of one field deviates by 0.15 of it.
    usual = 0.9 * 4 * np.pi * width**2 / apart**2 if width else 1.05
    assert np.mean(inflation) == pytest.approx(usual, rel=3 * 0.15 / np.sqrt(len(inflation)))
