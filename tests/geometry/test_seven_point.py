from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import find_fundamental

from fmtorch.geometry import canonical, seven_point
from tests.conftest import oracle
from tests.geometry.scenes import scene, scenes
from tests.reference import solvers as reference

# Seven matches of images 0000 and 0001 of Strecha's fountain-P11 and the one solution of cv2.findFundamentalMat.
FOUNTAIN_X0 = np.array(
    [[762.8362, 22.082304], [995.06055, 180.50838], [909.2012, 399.3417], [1088.8765, 363.64493],
     [1100.9924, 365.69138], [574.39386, 881.681], [968.3122, 199.01802]], np.float32)  # fmt: skip
FOUNTAIN_X1 = np.array(
    [[794.99347, 43.264782], [1063.7501, 217.31793], [965.13586, 431.47452], [1168.8638, 402.60098],
     [1182.1827, 405.38974], [648.85474, 927.8278], [1032.3232, 234.20705]], np.float32)  # fmt: skip
FOUNTAIN_F = np.array(
    [[9.1962601249878199e-07, -1.4472888712085847e-06, 1.7821514303694879e-03],
     [1.1627277107841912e-06, -7.1967627600388522e-07, -3.7014883547412613e-03],
     [-3.8345938740811940e-03, 4.4629213417958580e-03, 9.9997425023764808e-01]])  # fmt: skip


def distance_to_nearest(F, solutions):
    """For each of the solutions the distance to the nearest row of F, all of unit norm and sign."""
    return (F[:, None] - solutions[None]).norm(dim=(-2, -1)).min(0).values


def test_opencv_and_kornia_oracle():
    data = oracle("epipolar_7pt.npz")
    for i in range(len(data["names"])):
        x0, x1 = (torch.from_numpy(data[f"{i:03d}.X{k}"]) for k in (1, 2))
        F, valid = seven_point(x0, x1)
        theirs = canonical(torch.from_numpy(data[f"{i:03d}.F_opencv"]))
        assert valid.sum() == len(theirs)
        assert distance_to_nearest(F[valid], theirs).max() < 3e-12  # the oracles' own agreement
        assert not F[~valid].any()


def test_opencv_figures():
    x0 = torch.from_numpy(FOUNTAIN_X0.astype(np.float64))
    x1 = torch.from_numpy(FOUNTAIN_X1.astype(np.float64))
    F, valid = seven_point(x0, x1)
    assert valid.sum() == 1
    assert (F[valid] - torch.from_numpy(FOUNTAIN_F)).norm() < 3e-12  # as for the oracle files


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_reference_opencv_and_kornia_live(batch):
    x0, x1, _ = (a.float().double() for a in scenes(batch, 7))  # OpenCV rounds points to float32
    F, valid = seven_point(x0, x1)
    assert F.shape == (*batch, 3, 3, 3)
    for i in np.ndindex(batch):
        a, b = x0[i].numpy(), x1[i].numpy()
        ours = F[i][valid[i]]
        ref = torch.from_numpy(np.stack(reference.seven_point(a, b)))
        stacked = torch.from_numpy(cv2.findFundamentalMat(a, b, cv2.FM_7POINT)[0].reshape(-1, 3, 3))
        kornia = find_fundamental(x0[i][None], x1[i][None], method="7POINT")[0]
        kornia = kornia[kornia.abs().amax((1, 2)) > 0]
        for theirs in (ref, stacked, kornia):
            assert len(theirs) == len(ours)
            # the null space's and the root's condition numbers, up to 1e3 each, times eps, and some room
            assert distance_to_nearest(ours, canonical(theirs)).max() < 1e-9
        assert torch.linalg.det(ours).abs().max() < 1e-15


def test_exact_points_give_the_true_matrix():
    x0, x1, F_true = scenes((200,), 7, seed=7)
    F, valid = seven_point(x0, x1)
    nearest = torch.where(valid, (F - canonical(F_true)[:, None]).norm(dim=(-2, -1)), torch.inf).amin(-1)
    assert nearest.median() < 1e-12
    assert nearest.max() < 1e-7  # a pair of roots closer than 1e-3 has a condition of more than 1e6 among 200 samples


def test_float32():
    x0, x1, F_true = scenes((200,), 7, seed=3)
    F, valid = seven_point(x0.float(), x1.float())
    assert F.dtype == torch.float32
    assert valid.any(-1).all()
    # Solved in float64 for the rounded points: the same as the float64 solver on those, but for the final rounding.
    F64, _ = seven_point(x0.float().double(), x1.float().double())
    assert torch.equal(F, F64.float())
    # Input rounding is 2^-15 px at 512 px, like noise of that size: the epipolar residual of the true model's
    # solution stays at the noise, amplified by the sample's condition; half of the samples are within 10 times.
    best = (F - canonical(F_true)[:, None].float()).norm(dim=(-2, -1)).amin(-1)
    assert best.median() < 1e-4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_samples_are_invalid_and_alone(dtype):
    x0, x1, _ = (a.to(dtype).clone() for a in scenes((8,), 7))
    good, good_valid = seven_point(x0, x1)
    x0[0, 3], x1[0, 3] = x0[0, 1], x1[0, 1]  # a repeated match
    x0[1], x1[1] = x0[1, :1], x1[1, :1]  # all the same
    x0[2, 4, 1] = torch.nan
    x1[3, 0, 0] = torch.inf
    line = torch.arange(7, dtype=dtype)[:, None]
    x0[4], x1[4] = line * torch.tensor([8.0, 16], dtype=dtype), line * torch.tensor([4.0, 4], dtype=dtype)
    x0[5], x1[5] = 0, 0
    F, valid = seven_point(x0, x1)
    assert not valid[:6].any()
    assert not F[:6].any()
    assert torch.equal(F[6:], good[6:])
    assert torch.equal(valid[6:], good_valid[6:])


def test_a_plane_is_degenerate():
    s = scene(7, planar=True)
    assert not seven_point(s.x0, s.x1)[1].any()


def test_no_root_is_lost_at_infinity():
    # Every basis of the null space of these equations serves: solutions are found for any order of the points.
    s = scene(7, seed=5)
    F, valid = seven_point(s.x0, s.x1)
    for seed in range(20):
        order = torch.randperm(7, generator=torch.Generator().manual_seed(seed))
        G, also = seven_point(s.x0[order], s.x1[order])
        assert also.sum() == valid.sum()
        assert distance_to_nearest(G[also], F[valid]).max() < 1e-9


def test_bits_do_not_depend_on_the_neighbours():
    x0, x1, _ = scenes((33,), 7)
    F, valid = seven_point(x0, x1)
    for i in range(33):
        alone, alone_valid = seven_point(x0[i], x1[i])
        assert torch.equal(alone, F[i])
        assert torch.equal(alone_valid, valid[i])


def test_gradient():
    s = scene(7, seed=1)
    x0, x1 = (s.x0 / 500).requires_grad_(), (s.x1 / 500).requires_grad_()

    def invariant(a, b):
        F, valid = seven_point(a, b)
        return F[valid] @ F[valid].mT  # independent of the sign

    assert torch.autograd.gradcheck(invariant, (x0, x1))


def test_gradient_is_finite_on_degenerate_samples():
    x0, x1, _ = scenes((4,), 7)
    x0[0], x1[0] = x0[0, :1].clone(), x1[0, :1].clone()
    x0[1, 1], x1[1, 1] = x0[1, 0].clone(), x1[1, 0].clone()
    x0[2, 0, 0] = torch.nan
    x0, x1 = x0.requires_grad_(), x1.requires_grad_()
    seven_point(x0, x1)[0].square().sum().backward()
    assert x0.grad is not None
    assert x1.grad is not None
    assert x0.grad.isfinite().all()
    assert x1.grad.isfinite().all()
