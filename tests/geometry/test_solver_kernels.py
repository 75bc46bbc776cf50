"""Minimal solvers and the weighted eight-point algorithm by kernels, against the tensor form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.solvers import EightPoint, SevenPoint
from fmtorch.geometry import eight_point
from fmtorch.geometry.eight_point_kernels import eight_point as eight_point_kernel
from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from fmtorch.geometry.seven_point_kernels import seven_point as seven_point_kernel
from tests.laws import degenerate, scene, small

pytest.importorskip("numba", reason="numba is not installed")

Kernel = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], int]
SOLVERS: dict[str, tuple[type[SevenPoint] | type[EightPoint], Kernel, int]] = {
    "seven": (SevenPoint, seven_point_kernel, 3),
    "eight": (EightPoint, eight_point_kernel, 1),
}


def pairs() -> dict[str, NormalizedPairs]:
    given = {"random": scene(1, 300), **degenerate(), **small()}
    made = {name: normalized_pairs(c, 0, 7)[0] for name, c in given.items()}
    return {name: some[0] for name, some in made.items() if some}


@pytest.mark.parametrize("solver", SOLVERS)
def test_models_are_those_of_the_tensor_form(solver: str) -> None:
    make, kernel, most = SOLVERS[solver]
    compared = 0
    for name, pair in pairs().items():
        n = int(pair.count[0])
        points = np.ascontiguousarray(pair.points[:, 0, :n].numpy())
        rng = np.random.default_rng(0)
        size = make.size
        sample = np.stack([rng.permutation(max(n, size))[:size] % n for _ in range(203)], 1)  # 203: not whole lanes
        F, draw = np.empty((most * 203, 9), np.float32), np.empty(most * 203, np.int64)
        count = kernel(points, sample, F, draw)
        expected, valid = make()(torch.from_numpy(points[:, sample])[:, :, None])
        draws = np.repeat(np.arange(203), most)[valid[0].numpy()]
        if name == "random":
            np.testing.assert_array_equal(draw[:count], draws)
            # float32 models; float64 solutions are exact to 1e-16 times their condition.
            np.testing.assert_allclose(F[:count], expected[:, valid].T.numpy(), atol=2e-6, err_msg=name)
            compared += count
        assert np.isfinite(F[:count]).all()
        np.testing.assert_allclose(np.linalg.norm(F[:count], axis=1), 1, atol=1e-5)
        assert (np.diff(draw[:count]) >= 0).all()
    assert compared > 20


@pytest.mark.parametrize("solver", SOLVERS)
def test_models_explain_their_samples(solver: str) -> None:
    make, kernel, most = SOLVERS[solver]
    pair = pairs()["random"]
    points = np.ascontiguousarray(pair.points[:, 0, :300].numpy())
    rng = np.random.default_rng(1)
    sample = np.stack([rng.permutation(300)[: make.size] for _ in range(500)], 1)
    F, draw = np.empty((most * 500, 9), np.float32), np.empty(most * 500, np.int64)
    count = kernel(points, sample, F, draw)
    models = F[:count].astype(np.float64).reshape(-1, 3, 3)
    x0, x1 = (
        np.concatenate([p[:, sample[:, draw[:count]]], np.ones((1, make.size, count))])
        for p in (points[:2], points[2:])
    )
    assert np.abs(np.linalg.det(models)).max() < 1e-6
    if solver == "seven":
        assert np.abs(np.einsum("isk,kij,jsk->ks", x1, models, x0)).max() < 1e-5


def test_weighted_fits_are_those_of_the_tensor_form() -> None:
    compared = 0
    for name, pair in pairs().items():
        n = int(pair.count[0])
        points = np.ascontiguousarray(pair.points[:, 0, :n].numpy())
        for kind in ("ones", "random", "some", "none"):
            rng = np.random.default_rng(2)
            weight = {"ones": np.ones(n), "random": rng.random(n), "none": np.zeros(n)}.get(
                kind, rng.random(n) * (rng.random(n) < 0.5)
            )
            F = np.empty(9)
            found = weighted_eight_point(points, weight, F)
            x0, x1 = (torch.from_numpy(p.T.copy()) for p in (points[:2], points[2:]))
            expected, valid = eight_point(x0, x1, torch.from_numpy(weight))
            if name == "random":
                assert found == bool(valid), (name, kind)
            if found and name in ("random", "all outliers"):
                np.testing.assert_allclose(F, expected.flatten().numpy(), atol=1e-9, err_msg=f"{name}, {kind}")
                compared += 1
            assert not found or np.isfinite(F).all()
    assert compared >= 5
