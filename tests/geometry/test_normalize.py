import numpy as np
import pytest
import torch

from fmtorch.geometry import canonical, denormalize_fundamental, normalize_pair, normalize_points
from tests.geometry.scenes import scene, scenes
from tests.reference import solvers as reference


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_hartley_equals_the_definition(batch):
    x, _, _ = scenes(batch, 20)
    w = torch.rand(*batch, 20, dtype=torch.float64)
    for weight in (None, w):
        y, T = normalize_points(x, weight=weight)
        for i in np.ndindex(batch):
            expected = reference.hartley(x[i].numpy(), None if weight is None else w[i].numpy())
            np.testing.assert_allclose(T[i], expected, rtol=1e-13, atol=1e-13)
            np.testing.assert_allclose(y[i], (reference.homogeneous(x[i].numpy()) @ expected.T)[:, :2], atol=1e-13)


def test_common_scale_is_one_scale():
    s = scene(30)
    x1 = 3 * s.x1
    y0, y1, T0, T1 = normalize_pair(s.x0, x1)
    assert torch.equal(T0[0, 0], T1[1, 1])
    assert y0.mean(0).abs().max() < 1e-14
    assert y1.mean(0).abs().max() < 1e-14
    assert ((y0.norm(dim=-1).mean() + y1.norm(dim=-1).mean()) / 2 - 2**0.5).abs() < 1e-14


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coincident_and_absent_points_keep_their_scale(dtype):
    same = torch.full((9, 2), 123.4, dtype=dtype, requires_grad=True)
    y, T = normalize_points(same)
    assert T[0, 0] == 1
    y.square().sum().backward()
    assert same.grad.isfinite().all()
    y, T = normalize_points(same, torch.zeros(9, dtype=torch.bool))
    assert torch.equal(T, torch.eye(3, dtype=dtype))
    assert not y.any()


def test_denormalised_f_vanishes_where_the_normalised_one_does():
    s = scene(20)
    (_, T0), (_, T1) = normalize_points(s.x0), normalize_points(s.x1)
    Fn = torch.linalg.inv(T1).mT @ s.F @ torch.linalg.inv(T0)
    torch.testing.assert_close(canonical(denormalize_fundamental(Fn, T0, T1)), canonical(s.F))


def test_canonical():
    F = torch.randn(6, 3, 3, dtype=torch.float64)
    U = canonical(F)
    torch.testing.assert_close(U, torch.stack([torch.from_numpy(reference.unit(f.numpy())) for f in F]))
    torch.testing.assert_close(canonical(-1e-200 * F), U)
    zero = torch.zeros(3, 3, requires_grad=True)
    canonical(zero).sum().backward()
    assert not canonical(zero).any()
    assert zero.grad.isfinite().all()


def test_gradients():
    s = scene(9)
    x0, x1 = (s.x0 / 500).requires_grad_(), (s.x1 / 500).requires_grad_()
    w = torch.rand(9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, w: normalize_points(x, weight=w), (x0, w))
    assert torch.autograd.gradcheck(lambda a, b: normalize_pair(a, b), (x0, x1))
    assert torch.autograd.gradcheck(canonical, (torch.randn(2, 3, 3, dtype=torch.float64, requires_grad=True),))
