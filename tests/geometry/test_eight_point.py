"""The eight-point algorithm and its steps: normalisation, rank 2."""

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import find_fundamental

from fmtorch import geometry
from tests.conftest import oracle
from tests.geometry.scenes import scene, scenes
from tests.reference import solvers as reference

EPS = torch.finfo(torch.float64).eps


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("n", [8, 9, 50])
def test_reference_opencv_and_kornia_live(batch, n):
    x0, x1, _ = (a.float().double() for a in scenes(batch, n, noise=0.5))  # OpenCV rounds points to float32
    w = torch.rand(*batch, n, dtype=torch.float64) + 0.1
    F, valid = geometry.eight_point(x0, x1)
    W, _ = geometry.eight_point(x0, x1, w)
    assert valid.all()
    for i in np.ndindex(batch):
        a, b = x0[i].numpy(), x1[i].numpy()
        theirs = torch.from_numpy(cv2.findFundamentalMat(a, b, cv2.FM_8POINT)[0])
        kornia = find_fundamental(x0[i][None], x1[i][None], torch.ones(1, n, dtype=torch.float64))[0]
        for solution, weights in ((F[i], None), (W[i], w[i].numpy()), (theirs, None), (kornia, None)):
            # M = A^T A is summed with a relative error of n eps, which moves its eigenvector by that over the gap; then
            # the undoing of the normalisation only shrinks: compared before it.
            expected = torch.from_numpy(reference.eight_point(a, b, weights))
            A, T0, T1 = reference.normalised_equations(a, b, weights)
            s = np.linalg.svd(A if weights is None else np.sqrt(weights)[:, None] * A)[1]
            gap = (s[7] ** 2 - (s[8] ** 2 if n > 8 else 0)) / s[0] ** 2
            U0, U1 = (torch.linalg.inv(torch.from_numpy(T)) for T in (T0, T1))
            error = geometry.canonical(U1.mT @ solution @ U0) - geometry.canonical(U1.mT @ expected @ U0)
            assert error.norm() < n * torch.finfo(torch.float64).eps / gap


@pytest.mark.parametrize("n", [8, 20])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_sets_are_invalid_and_alone(n, dtype):
    x0, x1, _ = (a.to(dtype).clone() for a in scenes((12,), n, noise=0.5))
    line = torch.arange(n, dtype=dtype)[:, None]
    x0[2], x1[2] = x0[2, :1], x1[2, :1]  # all equal
    x0[3], x1[3] = x0[3, torch.arange(n) % 7], x1[3, torch.arange(n) % 7]  # seven different matches
    x0[4], x1[4] = line * torch.tensor([8.0, 16], dtype=dtype), line * torch.tensor([4.0, 4], dtype=dtype)  # collinear
    x0[5, 3, 0] = torch.nan
    x1[6, 0, 1] = -torch.inf
    x0[7], x1[7] = 0, 0
    plane = scene(n, planar=True)
    x0[8], x1[8] = plane.x0.to(dtype), plane.x1.to(dtype)
    x0[9] = x0[9, :1]  # coincident in image 0 only
    x1[10] = x0[10]  # no motion
    x0[11] = torch.nan
    F, valid = geometry.eight_point(x0, x1)
    assert valid.tolist() == [True] * 2 + [False] * 10
    assert not F[2:].any()
    assert torch.equal(F[:2], geometry.eight_point(x0[:2], x1[:2])[0])


def test_bad_weights():
    x0, x1, _ = scenes((4,), 20)
    w = torch.ones(4, 20, dtype=torch.float64)
    w[0, 3], w[1, 3], w[2] = -1.0, torch.nan, 0.0
    assert geometry.eight_point(x0, x1, w)[1].tolist() == [False, False, False, True]


def test_gradient():
    s = scene(12, noise=0.5)
    x0, x1 = (s.x0 / 500).requires_grad_(), (s.x1 / 500).requires_grad_()
    w = torch.rand(12, dtype=torch.float64) + 0.2
    w[3] = 0.0
    w[-1] = 1.5  # the largest stays the largest

    def invariant(a, b, w):
        F, _ = geometry.eight_point(a, b, w)
        return F @ F.mT

    assert torch.autograd.gradcheck(lambda a, b: invariant(a, b, w), (x0, x1))
    free = torch.arange(12) != 3  # a zero weight may only grow
    v = w[free].clone().requires_grad_()
    full = torch.zeros(12, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda v: invariant(x0.detach(), x1.detach(), full.masked_scatter(free, v)), (v,))
    # at zero: against a one-sided difference
    w0 = w.clone().requires_grad_()
    loss = invariant(x0.detach(), x1.detach(), w0)[0, 0]
    (gradient,) = torch.autograd.grad(loss, w0)
    step = 1e-7
    moved = w.clone()
    moved[3] = step
    difference = (invariant(x0.detach(), x1.detach(), moved)[0, 0] - loss.detach()) / step
    torch.testing.assert_close(gradient[3], difference, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_hartley_equals_the_definition(batch):
    x, _, _ = scenes(batch, 20)
    w = torch.rand(*batch, 20, dtype=torch.float64)
    for weight in (None, w):
        y, T = geometry.normalize_points(x, weight=weight)
        for i in np.ndindex(batch):
            expected = reference.hartley(x[i].numpy(), None if weight is None else w[i].numpy())
            np.testing.assert_allclose(T[i], expected, rtol=1e-13, atol=1e-13)
            np.testing.assert_allclose(y[i], (reference.homogeneous(x[i].numpy()) @ expected.T)[:, :2], atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coincident_and_absent_points_keep_their_scale(dtype):
    same = torch.full((9, 2), 123.4, dtype=dtype, requires_grad=True)
    y, T = geometry.normalize_points(same)
    assert T[0, 0] == 1
    y.square().sum().backward()
    assert same.grad.isfinite().all()
    y, T = geometry.normalize_points(same, torch.zeros(9, dtype=torch.bool))
    assert torch.equal(T, torch.eye(3, dtype=dtype))
    assert not y.any()


def test_canonical():
    F = torch.randn(6, 3, 3, dtype=torch.float64)
    U = geometry.canonical(F)
    torch.testing.assert_close(U, torch.stack([torch.from_numpy(reference.unit(f.numpy())) for f in F]))
    torch.testing.assert_close(geometry.canonical(-1e-200 * F), U)
    zero = torch.zeros(3, 3, requires_grad=True)
    geometry.canonical(zero).sum().backward()
    assert not geometry.canonical(zero).any()
    assert zero.grad.isfinite().all()


def test_gradients_of_normalisation():
    s = scene(9)
    x0 = (s.x0 / 500).requires_grad_()
    w = torch.rand(9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, w: geometry.normalize_points(x, weight=w), (x0, w))
    F = torch.randn(2, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(geometry.canonical, (F,))
    assert torch.autograd.gradcheck(geometry.nearest_rank2, (random_matrices((2, 3)).requires_grad_(),))


def random_matrices(batch, singular_values=None, seed=0):
    F = torch.randn(*batch, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    if singular_values is None:
        return F
    U, _, Vt = torch.linalg.svd(F)
    return U @ torch.diag(torch.tensor(singular_values, dtype=torch.float64)) @ Vt


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (500,)])
def test_equals_the_svd(batch):
    F = random_matrices(batch)
    P = geometry.nearest_rank2(F)
    for i in np.ndindex(batch):
        S = np.linalg.svd(F[i].numpy())[1]
        # The last singular vector of a matrix known to eps |F| is known to eps |F| / gap.
        np.testing.assert_allclose(P[i], reference.rank2(F[i].numpy()), atol=32 * EPS * S[0] ** 2 / (S[1] - S[2]))


@pytest.mark.parametrize(
    "s",
    [(1, 1, 1), (1, 0.5, 0.5), (1, 1, 0.5), (1, 0.5, 0.5 - 1e-9), (1, 1e-3, 1e-6), (1, 1e-6, 1e-9), (1, 1e-10, 1e-12),
     (1, 1e-14, 0), (1, 1e-15, 1e-15), (1, 0, 0), (0, 0, 0), (1e-200, 1e-201, 1e-202), (1e100, 1e99, 1e98)],
)  # fmt: skip
def test_nearest_even_where_the_singular_vector_is_not_unique(s):
    F = random_matrices((200,), s)
    P = geometry.nearest_rank2(F)
    distance = torch.linalg.matrix_norm((P - F) / max(s[0], 1e-300)) * max(s[0], 1e-300)
    # Between singular values closer than sqrt(eps) the vector may lie anywhere: no farther than the second one.
    second = s[1] if abs(s[1] - s[2]) < EPS**0.5 * s[1] else s[2]
    assert (distance <= second + 16 * EPS * s[0]).all()
    assert (torch.linalg.svdvals(P)[:, 2] <= 16 * EPS * s[0]).all()


def test_float32_is_the_rounded_float64():
    F = random_matrices((50,)).float()
    assert torch.equal(geometry.nearest_rank2(F), geometry.nearest_rank2(F.double()).float())


@pytest.mark.parametrize("s", [(1, 1, 1), (1, 0.5, 0.5), (1, 0.5, 0.5 - 1e-9), (1, 0, 0), (0, 0, 0)])
def test_gradient_stays_bounded(s):
    F = random_matrices((50,), s).requires_grad_()
    target = random_matrices((50,), seed=1)
    (geometry.nearest_rank2(F) * target).sum().backward()
    # |d(F v v^T)| <= |dF| + 2 s3 |dv|; |dv| <= 2 s1 |dF| max gap / (gap^2 + eps^2) = s1 |dF| / eps; eps = 1e-6 s1^2.
    assert F.grad.isfinite().all()
    assert F.grad.norm(dim=(1, 2)).max() <= (1 + 2e6) * target.norm(dim=(1, 2)).max()


def test_opencv_and_kornia_oracle():
    data = oracle("epipolar_8pt.npz")
    for i in range(len(data["names"])):
        case = {k: torch.from_numpy(data[f"{i:03d}.{k}"]) for k in ("X1", "X2", "weights")}
        theirs = {k: geometry.canonical(torch.from_numpy(data[f"{i:03d}.{k}"]))
                  for k in ("F_opencv", "F_kornia", "F_kornia_weighted")}  # fmt: skip
        F, valid = geometry.eight_point(case["X1"], case["X2"])
        weighted, _ = geometry.eight_point(case["X1"], case["X2"], case["weights"])
        assert valid
        # OpenCV and kornia agree to 3.1e-10 among themselves (n9 of the last pair, the least determined).
        assert (F - theirs["F_opencv"]).norm() < 4e-10
        assert (F - theirs["F_kornia"]).norm() < 4e-10
        assert (weighted - theirs["F_kornia_weighted"]).norm() < 4e-10
