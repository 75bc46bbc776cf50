"""One pair of a batch as estimators see it, and pairs of many kinds to try their parts on."""

from __future__ import annotations

import functools

import numpy as np
import torch
from numpy.typing import NDArray

from fmtorch.core.types import Correspondences
from fmtorch.estimators.batch import Batch
from fmtorch.estimators.pair import Pair
from fmtorch.geometry.eight_point_kernels import weighted_eight_point
from tests.conftest import oracle
from tests.laws import scene, small

MINIMAL = 7
SCALES = (1e-9, 1.0, 1e9)
FEW = tuple(name for name in small() if not name.endswith(" coincident") or "half" in name)
"""Names of pairs of 7 to 20 matches, those included that determine no model, but not those refused unseen."""
REAL = ("real 0", "real 7", "real 13")


def one_pair(c: Correspondences, i: int = 0, seed: int = 0) -> Pair:
    """A pair of a batch; AssertionError, with the reason, where it is none to estimate."""
    batch = Batch.of(c)
    with np.errstate(all="ignore"):
        normalized = batch.normalized(batch.pair(i), i, seed, MINIMAL)
    assert not isinstance(normalized, str), normalized
    return normalized[0]


def known(count: int, kind: str = "all") -> Correspondences:
    """A scene of so many matches with prior, noise and quality, or with nothing."""
    c = scene(count, count).replace(noise=torch.linspace(0.2, 5, count)[None])
    return c.replace(prior=None, quality=None, noise=None) if kind == "nothing" else c


@functools.cache
def real(i: int) -> Correspondences:
    """One of the real pairs of the test data, matches alone."""
    file = oracle("robust.npz")
    x0, x1 = (torch.from_numpy(file[f"{i:03d}.{field}"])[None] for field in ("X1", "X2"))
    return Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool), key=torch.tensor([i]))


def named(name: str, scale: float = 1.0, seed: int = 0) -> Pair:
    """The pair "scene 150", "real 7", or one of FEW, its coordinates times a scale."""
    kind, _, rest = name.partition(" ")
    c = known(int(rest)) if kind == "scene" else real(int(rest)) if kind == "real" else small()[name]
    return one_pair(c.replace(x0=scale * c.x0.double(), x1=scale * c.x1.double()), seed=seed)


def models(pair: Pair, count: int) -> NDArray[np.float64]:
    """Models (count, 9) of eights of the pair's matches, which fit some others, and of none; the first is zero."""
    rng, F = np.random.default_rng(0), np.zeros((count, 9))
    F[1:] = rng.normal(size=(count - 1, 9))
    for k in range(2, count, 2):
        eight = np.ascontiguousarray(pair.points[:, rng.permutation(pair.count)[:8]])
        weighted_eight_point(eight, np.ones(eight.shape[1]), F[k])
    return F
