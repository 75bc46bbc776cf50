"""One pair as estimators see it, for tests of their parts."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from fmtorch.core.types import Correspondences
from fmtorch.estimators.batch import Batch
from fmtorch.estimators.pair import Pair
from tests.conftest import oracle

SEED = 3
REAL = (0, 7, 12, 22)  # real pairs: many and few inliers, and the one of fewest matches


def one_pair(c: Correspondences, row: int = 0, seed: int = SEED, minimal: int = 7) -> Pair:
    """One row of a batch; raises ValueError with the reason where it cannot be estimated."""
    batch = Batch.of(c.detach())
    normalized = batch.normalized(batch.pair(row), row, seed, minimal)
    if isinstance(normalized, str):
        raise ValueError(normalized)
    return normalized[0]


def pair_of(x0: Any, x1: Any, seed: int = SEED, minimal: int = 7, key: int = 0, **known: Any) -> Pair:
    """The pair of matches (n, 2) in pixels. known: `prior`, `noise`, `quality` (n,), `size0`, `size1` (h, w)."""
    return one_pair(correspondences(x0, x1, key, **known), 0, seed, minimal)


def correspondences(x0: Any, x1: Any, key: int = 0, **known: Any) -> Correspondences:
    """A batch of one pair, as `pair_of` takes it."""
    values = {name: torch.as_tensor(np.array(value))[None] for name, value in {"x0": x0, "x1": x1, **known}.items()}
    mask = torch.ones(values["x0"].shape[:2], dtype=torch.bool)
    return Correspondences(mask=mask, key=torch.tensor([key]), **values)


def real(number: int, sizes: bool = False, most: int | None = None) -> Correspondences:
    """A real pair of oracles/robust.npz, at most so many of its matches, with or without the sizes of its images."""
    file = oracle("robust.npz")
    x0, x1, size0, size1 = (file[f"{number:03d}.{name}"] for name in ("X1", "X2", "size1", "size2"))
    known = {"size0": size0.astype(np.int64), "size1": size1.astype(np.int64)} if sizes else {}
    return correspondences(x0[:most], x1[:most], number, **known)


def real_pair(number: int) -> Pair:
    """A real pair, normalised."""
    return one_pair(real(number))
