"""Minimal solvers, the oriented constraint and the weighted eight-point algorithm by kernels, against definitions."""

from collections.abc import Callable

import numpy as np
import pytest

from fmtorch.geometry.eight_point import eight_point_kernel, weighted_eight_point
from fmtorch.geometry.seven_point import seven_point_kernel
from tests.estimators.pairs import normalized
from tests.laws import degenerate, scene, small
from tests.reference import solvers as reference

Kernel = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], int]
SOLVERS: dict[str, tuple[Kernel, int, int]] = {"seven": (seven_point_kernel, 7, 3), "eight": (eight_point_kernel, 8, 1)}
DRAWS = 203  # not whole lanes


def points_of() -> dict[str, np.ndarray]:
    """Points (4, n) of pairs of many kinds, in normalised units."""
    given = {"random": scene(1, 300), "right": scene(1, 300, outliers=0, noise=0), **degenerate(), **small()}
    pairs = {name: normalized(c) for name, c in given.items()}
    return {name: pair.points for name, pair in pairs.items() if pair is not None}


def solved(solver: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Models (m, 9) of random samples, of which draw each is, and the samples (size, DRAWS)."""
    kernel, size, most = SOLVERS[solver]
    rng, n = np.random.default_rng(0), points.shape[1]
    sample = np.stack([rng.permutation(max(n, size))[:size] % n for _ in range(DRAWS)], 1)
    F, draw = np.empty((most * DRAWS, 9), np.float32), np.empty(most * DRAWS, np.int64)
    count = kernel(points, sample, F, draw)
    return F[:count].astype(np.float64), draw[:count], sample


@pytest.mark.parametrize("solver", SOLVERS)
def test_models_of_any_matches_are_sound_and_explain_their_samples(solver: str) -> None:
    for name, points in points_of().items():
        F, draw, sample = solved(solver, points)
        assert np.isfinite(F).all()
        assert (np.diff(draw) >= 0).all()
        np.testing.assert_allclose(np.linalg.norm(F, axis=1), 1, atol=1e-5)
        assert np.abs(np.linalg.det(F.reshape(-1, 3, 3))).max(initial=0) < 1e-6, name
        own = np.concatenate([points[:, sample[:, draw]], np.ones((1, *sample[:, draw].shape))])
        if solver == "seven":  # float32 models of points within 1
            residual = np.einsum("isk,kij,jsk->ks", own[[2, 3, 4]], F.reshape(-1, 3, 3), own[[0, 1, 4]])
            assert np.abs(residual).max(initial=0) < 1e-5, name


def test_samples_of_right_matches_pass_the_oriented_constraint_and_most_others_fail() -> None:
    right, random = points_of()["right"], normalized(scene(1, 300, outliers=1.0))
    _, draw, _ = solved("seven", right)
    assert len(set(draw)) > 0.9 * DRAWS  # the rest magnifies the rounding of the points, which are float32
    F, _, _ = solved("seven", random.points)
    x = random.points
    every = [len(reference.seven_point(x[:2, i : i + 7].T, x[2:, i : i + 7].T)) for i in range(0, 280, 7)]
    assert len(F) / DRAWS < 0.2 * np.mean(every)


@pytest.mark.parametrize("kind", ["ones", "random", "some", "none"])
def test_weighted_fits_are_those_of_the_definition(kind: str) -> None:
    for name, points in points_of().items():
        rng, n = np.random.default_rng(2), points.shape[1]
        sparse = rng.random(n) * (rng.random(n) < 0.5)
        weight = {"ones": np.ones(n), "random": rng.random(n), "some": sparse, "none": np.zeros(n)}[kind]
        F = np.empty(9)
        solved = weighted_eight_point(points, weight, F)
        assert not solved or np.isfinite(F).all()
        if name in ("random", "right", "all outliers"):
            assert solved == (kind != "none")
            if solved:
                theirs = reference.eight_point(points[:2].T, points[2:].T, weight).ravel()
                # The sums of 300 products, each rounded, over the gap of the eigenvalues, some 1e-5.
                np.testing.assert_allclose(F * np.sign(F @ theirs), theirs, atol=1e-8, err_msg=name)
