"""Fundamental matrices from cameras, epipolar lines and distances: known answers, references, peers, laws."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fmtorch import geometry
from tests.conftest import oracle
from tests.geometry.scenes import scenes, stacked
from tests.reference import solvers as reference

DISTANCES = ["symmetric_mean", "symmetric_max", "symmetric_squared", "sampson", "sampson_squared"]
MATRIX, POINTS = (2, 3, 3), (2, 3, 2)
SHAPES = {
    **dict.fromkeys([*DISTANCES, "algebraic"], (MATRIX, POINTS, POINTS)),
    "epipolar_lines": (MATRIX, POINTS),
    "point_to_line": (POINTS, MATRIX),
    "fundamental_from_calibration": (MATRIX, MATRIX, MATRIX, (2, 3)),
    "fundamental_from_projections": ((2, 3, 4), (2, 3, 4)),
}


def up_to_sign(F: Tensor, like: Tensor) -> Tensor:
    return F * (F * like).sum((-2, -1), keepdim=True).sign()


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
def test_matches_scalar_reference(batch: tuple[int, ...]) -> None:
    x0, x1, F = scenes(batch, 7, 3, noise=3.0)
    d0, d1 = geometry.epipolar_distances(F, x0, x1)
    lines, sampson = geometry.epipolar_lines(F, x0), geometry.sampson(F, x0, x1)
    mean, largest = geometry.symmetric_mean(F, x0, x1), geometry.symmetric_max(F, x0, x1)
    for index in np.ndindex(*x0.shape[:-1]):
        f, p0, p1 = F[index[:-1]].numpy(), x0[index].numpy(), x1[index].numpy()
        expected = reference.epipolar_distances(f, p0, p1)
        assert (d0[index].item(), d1[index].item()) == pytest.approx(expected, rel=1e-9)
        assert mean[index].item() == pytest.approx(np.mean(expected), rel=1e-9)
        assert largest[index].item() == pytest.approx(max(expected), rel=1e-9)
        assert sampson[index].item() == pytest.approx(abs(reference.sampson(f, p0[None], p1[None])[0]), rel=1e-9)
        np.testing.assert_allclose(lines[index].numpy(), reference.line(f, p0), atol=1e-9)
        near = geometry.point_to_line(x1[index][None], lines[index][None])
        assert near.item() == pytest.approx(expected[1], rel=1e-9)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_projections_match_scalar_reference(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    g = torch.Generator().manual_seed(0)
    P0, P1 = (torch.randn(*batch, 3, 4, generator=g, dtype=torch.float64).to(dtype) for _ in range(2))
    F = geometry.fundamental_from_projections(P0, P1)
    assert F.dtype == dtype
    for index in np.ndindex(*batch):
        matrices = (P[index].double().numpy() for P in (P0, P1))
        expected = torch.from_numpy(reference.fundamental_from_projections(*matrices))
        # 24 products of four numbers of size one, over a norm of size one.
        atol = 100 * torch.finfo(dtype).eps
        torch.testing.assert_close(up_to_sign(F[index].double(), expected), expected, atol=atol, rtol=0)


def test_calibration_and_projections_agree_in_sign_too() -> None:
    _, _, _, K0, K1, R, t = stacked((20,), 1)
    P0 = torch.cat([K0, torch.zeros(20, 3, 1, dtype=torch.float64)], -1)
    P1 = K1 @ torch.cat([R, t[..., None]], -1)
    F = geometry.fundamental_from_calibration(K0, K1, R, t)
    torch.testing.assert_close(F, geometry.fundamental_from_projections(P0, P1), atol=1e-12, rtol=0)
    torch.testing.assert_close(torch.linalg.matrix_norm(F), torch.ones(20, dtype=torch.float64))
    assert torch.linalg.det(F).abs().max() < 1e-15


def test_projections_oracle() -> None:
    file = oracle("fundamental_from_projections.npz")
    F = geometry.fundamental_from_projections(torch.from_numpy(file["P1"]), torch.from_numpy(file["P2"]))
    kornia = geometry.unit_frobenius(torch.from_numpy(file["F_kornia"]))
    torch.testing.assert_close(up_to_sign(F, kornia), kornia, atol=1e-13, rtol=0)
    gt = torch.from_numpy(file["F_gt"])  # from R, t of six digits
    torch.testing.assert_close(up_to_sign(F, gt), gt, atol=2e-5, rtol=0)


def test_distances_oracle() -> None:
    file = oracle("epipolar_distances.npz")
    for case in range(len(file["names"])):
        get = {k[4:]: torch.from_numpy(v) for k, v in file.items() if k.startswith(f"{case:03d}.")}
        F, x0, x1 = get["F"], get["X1"], get["X2"]
        d0, d1 = geometry.epipolar_distances(F, x0, x1)
        # The residual cancels from terms of about 1e3 px: absolute errors of 1e3 * 2e-16 * 10 in a distance.
        tight = {"rtol": 1e-9, "atol": 1e-11}
        torch.testing.assert_close(d1, get["left_to_right_kornia"], **tight)
        torch.testing.assert_close(d0, get["right_to_left_kornia"], **tight)
        torch.testing.assert_close(geometry.sampson_squared(F, x0, x1), get["sampson_sq_opencv"], **tight)
        torch.testing.assert_close(geometry.sampson_squared(F, x0, x1), get["sampson_sq_kornia"], **tight)
        torch.testing.assert_close(geometry.symmetric_squared(F, x0, x1), get["symmetric_sq_kornia"], **tight)
        torch.testing.assert_close(geometry.epipolar_lines(F, x0), get["lines_in_2_opencv"], **tight)
        torch.testing.assert_close(geometry.epipolar_lines(F.mT, x1), get["lines_in_1_opencv"], **tight)


def test_algebraic_is_signed_and_scales_with_F() -> None:
    x0, x1, F = scenes((), 7, 2, noise=3.0)
    e = geometry.algebraic(F, x0, x1)
    ones = torch.ones(len(x0), 1, dtype=torch.float64)
    expected = torch.einsum("ni,ij,nj->n", torch.cat([x1, ones], -1), F, torch.cat([x0, ones], -1))
    torch.testing.assert_close(e, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(geometry.algebraic(-3 * F, x0, x1), -3 * e)


@settings(max_examples=30, deadline=None)
@given(exponent=st.floats(-30, 30), negative=st.booleans(), seed=st.integers(0, 100))
def test_distances_ignore_scale_and_sign(exponent: float, negative: bool, seed: int) -> None:
    x0, x1, F = scenes((), 7, seed, noise=3.0)
    scaled = F * 10**exponent * (-1 if negative else 1)
    for name in DISTANCES:
        function = getattr(geometry, name)
        torch.testing.assert_close(function(scaled, x0, x1), function(F, x0, x1), rtol=1e-9, atol=1e-11)


def random_inputs(*shapes: tuple[int, ...]) -> list[Tensor]:
    g = torch.Generator().manual_seed(0)
    return [torch.randn(*shape, generator=g, dtype=torch.float64).requires_grad_() for shape in shapes]


@pytest.mark.parametrize("name", SHAPES)
def test_gradcheck(name: str) -> None:
    assert torch.autograd.gradcheck(getattr(geometry, name), random_inputs(*SHAPES[name]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_epipole_and_exact_matches_have_finite_values_and_gradients(dtype: torch.dtype) -> None:
    """Point 0 is the epipole in both images, point 1 lies exactly on its line, point 2 is off it."""
    F = geometry.cross_matrix(torch.tensor([0.0, 0.0, 1.0], dtype=dtype)).requires_grad_()  # x1 ~ x0, epipoles (0, 0)
    x0 = torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 4.0]], dtype=dtype, requires_grad=True)
    x1 = torch.tensor([[0.0, 0.0], [6.0, 8.0], [6.0, 9.0]], dtype=dtype, requires_grad=True)
    for name in DISTANCES:
        d = getattr(geometry, name)(F, x0, x1)
        assert d[:2].tolist() == [0, 0]
        assert d[2] > 0
        for gradient in torch.autograd.grad(d.sum(), [F, x0, x1]):
            assert gradient.isfinite().all()
    assert geometry.epipolar_lines(F, x0)[0].tolist() == [0, 0, 0]
