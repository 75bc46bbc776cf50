"""The benchmark of cameras: what each level tells, peers, judgement, the table and the command."""

import cv2
import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences
from scripts.benchmark.cameras import applies, bougnoux, calibrations, described
from scripts.benchmark.runner import Item
from tests.helpers import cross_matrix
from tests.scripts.samples import item as plain_item
from tests.scripts.samples import pair

SIZES = np.array([[760, 1000], [760, 1000]])


K = np.array([[950.0, 0, 499.5], [0, 950, 379.5], [0, 0, 1]])


R = cv2.Rodrigues(np.array([0.05, 0.3, 0.02]))[0]


T = np.array([-1.0, 0.1, 0.3])


def item(K0: np.ndarray = K, name: str = "orbit/s/0") -> Item:
    """A pair of cameras with 200 right matches, of 0.1 px of noise, and 50 wrong ones of larger ratio."""
    rng = np.random.default_rng(0)
    X = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (250, 3))
    x0, x1 = (Y[:, :2] / Y[:, 2:] + rng.normal(0, 0.1, (250, 2)) for Y in (X @ K0.T, (X @ R.T + T) @ K.T))
    x1[200:] = rng.uniform(0, 760, (50, 2))
    of = pair(name, true_f(K0, K, R, T), K0=K0, K1=K, R=R, t=T)
    ratio = torch.linspace(0.3, 0.8, 250)[None]
    sizes, frame = torch.from_numpy(SIZES), torch.diag(torch.tensor([4.0, 4])).expand(1, 250, 2, 2)
    points = [torch.from_numpy(x)[None].float() for x in (x0, x1)]
    lafs0, lafs1 = (torch.cat([frame, x[..., None]], -1) for x in points)
    matches = Correspondences(
        *points, torch.ones(1, 250, dtype=torch.bool), ratio=ratio, lafs0=lafs0, lafs1=lafs1, size0=sizes[:1],
        size1=sizes[1:], key=torch.tensor([of.key]),
    )  # fmt: skip
    return plain_item(of, matches)


def true_f(K0: np.ndarray, K1: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.linalg.inv(K1).T @ cross_matrix(t) @ R @ np.linalg.inv(K0)


def zoomed(factor: float) -> np.ndarray:
    return K @ np.diag([factor, factor, 1])


def test_levels_tell_what_they_say() -> None:
    own = item()
    known, wrong, one_sided, shared, unknown = (
        described(level, own.pair, own.matches, 0) for level in ("known", "wrong", "one_sided", "shared", "unknown")
    )
    assert known.focal is not None
    assert known.K0 is not None
    assert wrong.K1 is not None
    assert known.focal[0, :, 1].tolist() == [0, 0]
    assert np.array_equal(known.K0[0], K)
    assert np.allclose(wrong.K1[0], zoomed(1.5))
    given = [k is not None for c in (one_sided, shared, unknown) for k in (c.K0, c.K1)]
    assert given == [True, False, False, False, False, False]
    assert [bool(c.shared_focal) for c in (shared, unknown)] == [True, False]
    assert np.array_equal(calibrations(unknown, np.array([3.0, 4]))[1], [[4, 0, 499.5], [0, 4, 379.5], [0, 0, 1]])
    assert applies("shared", own.pair)
    assert not applies("shared", item(zoomed(1.01)).pair)
    assert applies("unknown", item(zoomed(1.01)).pair)


def test_bougnoux_gives_the_focal_lengths_of_a_true_matrix() -> None:
    own = item(zoomed(1.3))
    unknown = described("unknown", own.pair, own.matches, 0)
    assert bougnoux(own.pair.F, unknown) == pytest.approx([1.3 * 950, 950], rel=1e-8)
    forward = true_f(K, K, np.eye(3), np.array([0, 0, 1.0]))  # axes that are one line determine none
    assert bougnoux(forward, unknown) == pytest.approx([1200, 1200])
