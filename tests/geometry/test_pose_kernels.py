"""The pose of one pair by a kernel, against the tensor form and singular value decompositions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fmtorch.geometry import pose_from_fundamental
from fmtorch.geometry.pose import pose
from tests.reference import known_cameras as reference
from tests.reference import solvers

CAMERAS = np.array([650.0, 319.5, 239.5, 820, 300.5, 249.5])
K0, K1 = (np.array([[f, 0, x], [0, f, y], [0, 0, 1]]) for f, x, y in (CAMERAS[:3], CAMERAS[3:]))


def pose_of(F: np.ndarray, s: reference.Scene, weight: np.ndarray) -> np.ndarray:
    out = np.full(13, np.nan)
    pose(np.ascontiguousarray(F), CAMERAS, s.x0, s.x1, weight, out)
    return out


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_it_is_that_of_all_decompositions(noise: float) -> None:
    for seed in range(10):
        s = reference.scene(seed, 40, noise, outliers=0.2, cameras=(K0, K1))
        rng = np.random.default_rng(seed)
        F = reference.fundamental(s.R, s.t, (K0, K1)) * rng.choice([-2, 3]) + 1e-7 * noise * rng.normal(size=(3, 3))
        weight = rng.uniform(0, 1, 40) * s.right
        out = pose_of(F, s, weight)
        tensors = [torch.from_numpy(value)[None] for value in (F, K0, K1, s.x0, s.x1)]
        graphed = pose_from_fundamental(*tensors, torch.ones(1, 40, dtype=torch.bool), torch.from_numpy(weight)[None])
        assert bool(graphed.valid)
        assert out[12] == 1
        np.testing.assert_allclose(out[:9].reshape(3, 3), graphed.R[0], atol=1e-9)
        np.testing.assert_allclose(out[9:12], graphed.t[0], atol=1e-9)
        R, t, _ = solvers.pose(F, K0, K1, s.x0[s.right], s.x1[s.right])
        np.testing.assert_allclose(out[:9].reshape(3, 3), R, atol=1e-6)
        np.testing.assert_allclose(out[9:12], t, atol=1e-6)
        if not noise:
            np.testing.assert_allclose(out[9:12], s.t, atol=1e-6)


def test_weights_decide_on_which_side_points_lie() -> None:
    """In both forms: three heavy matches of the true motion against seven light ones of its mirror image."""
    s = reference.scene(1, 10, outliers=0.0, cameras=(K0, K1))
    F = reference.fundamental(s.R, s.t, (K0, K1))
    mirrored = reference.scene(1, 10, outliers=0.0, cameras=(K0, K1))
    e0, e1 = np.linalg.svd(F)[2][2], np.linalg.svd(F.T)[2][2]
    for x, e in ((mirrored.x0, e0[:2] / e0[2]), (mirrored.x1, e1[:2] / e1[2])):
        x[:7] = 2 * e - x[:7]  # on the other side of the epipole, on the same lines
    weight = np.r_[np.full(7, 0.1), np.full(3, 1.0)]
    heavy, light = pose_of(F, mirrored, weight), pose_of(F, mirrored, np.ones(10))
    tensors = [torch.from_numpy(value)[None] for value in (F, K0, K1, mirrored.x0, mirrored.x1)]
    mask = torch.ones(1, 10, dtype=torch.bool)
    for out, each in ((heavy, torch.from_numpy(weight)[None]), (light, None)):
        graphed = pose_from_fundamental(*tensors, mask, each)
        np.testing.assert_allclose(out[:9].reshape(3, 3), graphed.R[0], atol=1e-9)
        np.testing.assert_allclose(out[9:12], graphed.t[0], atol=1e-9)
    np.testing.assert_allclose(heavy[9:12], s.t, atol=1e-6)
    assert np.abs(light[:12] - heavy[:12]).max() > 0.1


@pytest.mark.parametrize("kind", ["zero", "NaN", "rank 1", "no matches"])
def test_where_there_is_none_all_is_zero(kind: str) -> None:
    s = reference.scene(0, 10, cameras=(K0, K1))
    F = reference.fundamental(s.R, s.t, (K0, K1))
    F = {"zero": 0 * F, "NaN": np.nan * F, "rank 1": np.outer(F[0], F[1]), "no matches": F}[kind]
    assert not pose_of(F, s, np.full(10, 0.0 if kind == "no matches" else 1.0)).any()
