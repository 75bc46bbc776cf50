"""The five-point algorithm finds what an eigenvalue solver finds, and nothing else."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from fmtorch.geometry.five_point import five_point_components
from tests.reference.five_point import five_point

SAMPLES = 400


def _scene(seed: int, noise: float = 0.0, plane: bool = False) -> tuple[torch.Tensor, np.ndarray]:
    """Rays (4, 5, SAMPLES) and the true essential matrices (SAMPLES, 3, 3), each sample of another pair of cameras."""
    rng = np.random.default_rng(seed)
    X = np.concatenate([rng.uniform(-1.5, 1.5, (SAMPLES, 5, 2)), rng.uniform(3, 7, (SAMPLES, 5, 1))], 2)
    if plane:
        X[..., 2] = 5 + X[..., 0] * 0.3
    R = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, (SAMPLES, 3))).as_matrix()
    t = rng.normal(size=(SAMPLES, 3))
    Y = X @ R.transpose(0, 2, 1) + t[:, None]
    rays = np.concatenate([X[..., :2] / X[..., 2:], Y[..., :2] / Y[..., 2:]], 2) + rng.normal(0, noise, (SAMPLES, 5, 4))
    E = np.cross(np.eye(3)[None], t[:, None]).transpose(0, 2, 1) @ R
    return torch.from_numpy(rays).permute(2, 1, 0).contiguous(), E / np.linalg.norm(E, axis=(1, 2))[:, None, None]


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between matrices of unit norm, up to sign, all of a (m, 3, 3) to all of b (n, 3, 3)."""
    cosine = np.abs(a.reshape(-1, 9) @ b.reshape(-1, 9).T)
    return np.sqrt(np.maximum(2 - 2 * cosine, 0))


def test_solutions_are_essential_matrices_of_the_sample() -> None:
    rays, _ = _scene(0, noise=0.05)
    E, sample = five_point_components(rays)
    assert len(sample) > 2 * SAMPLES
    M = E.T.reshape(-1, 3, 3)
    h0, h1 = (torch.cat([x, torch.ones_like(x[:1])]) for x in (rays[:2], rays[2:]))
    residual = torch.einsum("ins,sij,jns->ns", h1[:, :, sample], M, h0[:, :, sample])
    trace = M @ M.mT @ M - torch.einsum("sij,sij->s", M, M)[:, None, None] * M / 2
    assert float(residual.abs().max()) < 1e-12
    # Four steps of Newton's method leave the roots of nearly double ones, a few in a hundred, to some digits.
    for error in (trace.abs().amax((1, 2)), torch.linalg.det(M).abs()):
        assert float(error.median()) < 1e-14
        assert float(error.quantile(0.95)) < 1e-6
        assert float(error.quantile(0.99)) < 1e-3
    torch.testing.assert_close(torch.linalg.norm(M, dim=(1, 2)), torch.ones(len(M), dtype=torch.float64))


def test_nine_tenths_of_the_real_solutions_are_found_in_the_order_of_the_samples() -> None:
    rays, _ = _scene(1, noise=0.02)
    E, sample = five_point_components(rays)
    assert bool((sample.diff() >= 0).all())
    found = total = spurious = 0
    for s in range(SAMPLES):
        x = rays[:, :, s].T.numpy()
        expected = five_point(x[:, :2], x[:, 2:])
        ours = E[:, sample == s].T.reshape(-1, 3, 3).numpy()
        d = _distance(ours, expected)
        found += int((d.min(0, initial=9) < 1e-4).sum())
        spurious += int((d.min(1, initial=9) > 1e-3).sum())
        total += len(expected)
    assert found > 0.85 * total  # two roots within one interval of the grid are missed
    assert spurious < 0.01 * total  # double roots that the eigenvalue solver takes for a complex pair


def test_the_true_pose_is_among_the_solutions_also_of_a_plane() -> None:
    for plane in (False, True):
        rays, truth = _scene(2, plane=plane)
        E, sample = five_point_components(rays)
        nearest = np.full(SAMPLES, 9.0)
        distance = np.linalg.norm(E.T.numpy() - truth.reshape(-1, 9)[sample], axis=1)
        opposite = np.linalg.norm(E.T.numpy() + truth.reshape(-1, 9)[sample], axis=1)
        np.minimum.at(nearest, sample.numpy(), np.minimum(distance, opposite))
        assert np.median(nearest) < 1e-10
        assert (nearest < 1e-5).mean() > 0.7  # the others are missed by the grid, more often on a plane


def test_a_sample_has_the_same_bits_alone() -> None:
    rays, _ = _scene(3, noise=0.05)
    E, sample = five_point_components(rays)
    for s in (0, 17, SAMPLES - 1):
        alone, zero = five_point_components(rays[:, :, s : s + 1].clone())
        assert torch.equal(alone, E[:, sample == s])
        assert bool((zero == 0).all())


def test_degenerate_samples_have_no_solution_and_harm_no_other() -> None:
    rays, _ = _scene(4)
    E, sample = five_point_components(rays)
    bad = rays.clone()
    bad[:, 1, 10] = bad[:, 0, 10]  # a match twice
    bad[0, 2, 20] = torch.nan
    bad[:, :, 30] = 0.0
    bad[1, 3, 40] = torch.inf
    others = ~torch.isin(sample, torch.tensor([10, 20, 30, 40]))
    E_bad, sample_bad = five_point_components(bad)
    assert not bool(torch.isin(sample_bad, torch.tensor([10, 20, 30, 40])).any())
    assert torch.equal(sample_bad, sample[others])
    assert torch.equal(E_bad, E[:, others])
