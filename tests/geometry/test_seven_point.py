import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import find_fundamental

from fmtorch.geometry import canonical, seven_point
from tests.conftest import oracle
from tests.geometry.scenes import scene, scenes
from tests.reference import solvers as reference


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


def test_gradient():
    s = scene(7, seed=1)
    x0, x1 = (s.x0 / 500).requires_grad_(), (s.x1 / 500).requires_grad_()

    def invariant(a, b):
        F, valid = seven_point(a, b)
        return F[valid] @ F[valid].mT  # independent of the sign

    assert torch.autograd.gradcheck(invariant, (x0, x1))
