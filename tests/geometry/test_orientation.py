"""The oriented epipolar constraint holds for what two cameras see, and tells most samples with a wrong match."""

from __future__ import annotations

import numpy as np
import torch

from fmtorch.geometry.minimal import seven_point_components
from fmtorch.geometry.orientation import consistently_oriented
from tests.laws import scene
from tests.reference import solvers as reference


def _samples(outliers: float, count: int = 400) -> torch.Tensor:
    """Minimal samples (4, 7, samples) of one scene, in about unit scale."""
    c = scene(0, 300, outliers=outliers, noise=0.0)
    x = torch.cat([c.x0[0], c.x1[0]], 1).T.double() / 480 - 1
    index = torch.rand(count, 300, generator=torch.Generator().manual_seed(0)).argsort(1)[:, :7]
    return x[:, index].permute(0, 2, 1).contiguous()


def test_agrees_with_the_definition() -> None:
    points = _samples(0.5, 60)
    F, valid = seven_point_components(points)
    batched = consistently_oriented(F, points[:, :, None])
    for slot, sample in valid.nonzero().tolist():
        x = points[:, :, sample].numpy()
        expected = reference.consistently_oriented(F[:, slot, sample].numpy().reshape(3, 3), x[:2].T, x[2:].T)
        assert bool(batched[slot, sample]) == expected


def test_samples_of_right_matches_pass_and_most_others_fail() -> None:
    points = _samples(0.0)
    F, valid = seven_point_components(points)
    truth = valid & _explains_all(F, points)
    assert truth.any(0).double().mean() > 0.9  # the rest magnifies the rounding of the points, which are float32
    assert consistently_oriented(F, points[:, :, None])[truth].all()
    points = _samples(1.0)
    F, valid = seven_point_components(points)
    assert consistently_oriented(F, points[:, :, None])[valid].double().mean() < 0.2


def _explains_all(F: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Whether each matrix (9, 3, s) satisfies the epipolar constraint of all samples' points, (3, s)."""
    h0, h1 = (torch.cat([x.flatten(1), torch.ones(1, x[0].numel(), dtype=x.dtype)]) for x in (points[:2], points[2:]))
    error = torch.einsum("in,ijks,jn->ksn", h1, F.unflatten(0, (3, 3)), h0).abs()
    return torch.as_tensor(error.amax(-1) < 1e-4)


def test_an_epipole_at_infinity_is_no_exception() -> None:
    x0 = np.random.default_rng(0).uniform(-1, 1, (2, 7))
    disparity = np.linspace(0.1, 0.5, 7)
    F = torch.tensor([0, 0, 0, 0, 0, -1.0, 0, 1.0, 0], dtype=torch.float64)[:, None]  # sideways motion: y1 = y0
    points = torch.from_numpy(np.concatenate([x0, x0 + np.stack([disparity, np.zeros(7)])]))[..., None]
    assert bool(consistently_oriented(F, points)[0])
