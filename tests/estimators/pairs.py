"""Pairs as parts of estimators see them, and models of theirs."""

from __future__ import annotations

import numpy as np

from fmtorch.core.types import Correspondences
from fmtorch.estimators.batch import Batch
from fmtorch.estimators.pair import Pair


def normalized(c: Correspondences, seed: int = 0, minimal: int = 7) -> Pair | None:
    """The first pair of a batch in normalised units; None where it cannot be estimated."""
    batch = Batch.of(c.detach())
    found = batch.normalized(batch.pair(0), 0, seed, minimal)
    return None if isinstance(found, str) else found[0]


def pair_of(c: Correspondences, seed: int = 0) -> Pair:
    """The first pair of a batch, which can be estimated."""
    pair = normalized(c, seed)
    assert pair is not None
    return pair


def to_units(F: np.ndarray, pair: Pair) -> np.ndarray:
    """A model (3, 3) of pixels as one (9,) of unit norm of a pair's points."""
    A0, A1 = frames(pair)
    G = A1.T @ F @ A0
    return np.asarray(G / np.linalg.norm(G)).ravel()


def in_pixels(F: np.ndarray, pair: Pair) -> np.ndarray:
    """A model (9,) of a pair's points as one (3, 3) of unit norm of pixels."""
    A0, A1 = (np.linalg.inv(A) for A in frames(pair))
    G = A1.T @ F.reshape(3, 3) @ A0
    return np.asarray(G / np.linalg.norm(G))


def frames(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """From a pair's points to pixels, of both images, (3, 3)."""
    unit, centre = pair.pixels_per_unit, pair.centre.tolist()
    A0, A1 = (np.array([[unit, 0, x], [0, unit, y], [0, 0, 1]]) for x, y in (centre[:2], centre[2:]))
    return A0, A1


def apart(F: np.ndarray, G: np.ndarray) -> float:
    """The distance of two models (9,), of unit norm up to sign."""
    F, G = F.ravel() / np.linalg.norm(F), G.ravel() / np.linalg.norm(G)
    return float(min(np.linalg.norm(F - G), np.linalg.norm(F + G)))
