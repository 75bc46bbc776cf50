"""Pairs of many kinds as parts of estimators see them, and models of theirs."""

import functools
from typing import NamedTuple

import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences, Estimator
from fmtorch.estimators import Batch, Pair
from fmtorch.geometry.eight_point import weighted_eight_point
from fmtorch.jit.kernel import Array
from tests.conftest import oracle
from tests.laws import quick, scene, small
from tests.reference.solvers import sampson

SCALES = (1e-9, 1.0, 1e9)
FEW = tuple(name for name in small() if not name.endswith(" coincident") or "half" in name)
"""Names of pairs of 7 to 20 matches, those included that determine no model, but not those refused unseen."""
REAL = ("real 0", "real 7", "real 13")
SUMS, ROW, LAST = 8, 3, 16
"""Roundings of a term of x1' F x0; of one of F x0 or F' x1; of squares, their sum, a quotient and a product."""


def normalized(c: Correspondences, seed: int = 0, minimal: int = 7, i: int = 0) -> tuple[Pair, Array] | str:
    """A pair of a batch in normalised units and its slots, or why it cannot be estimated."""
    batch = Batch.of(c.detach())
    with np.errstate(all="raise"):  # what overflows is no error of the caller's
        return batch.normalized(batch.pair(i), i, seed, minimal)


def pair_of(c: Correspondences, seed: int = 0, i: int = 0) -> Pair:
    """A pair of a batch, which can be estimated."""
    return normalized(c, seed, i=i)[0]


def named(name: str, scale: float = 1.0, seed: int = 0) -> Pair:
    """The pair "scene 150", "real 7", or one of FEW, its coordinates times a scale."""
    kind, _, rest = name.partition(" ")
    c = known(int(rest)) if kind == "scene" else real(int(rest)) if kind == "real" else small()[name]
    return pair_of(c.replace(x0=scale * c.x0.double(), x1=scale * c.x1.double()), seed)


def known(count: int, kind: str = "all") -> Correspondences:
    """A scene of so many matches with prior, noise and ratio, or with nothing."""
    c = scene(count, count).replace(noise=torch.linspace(0.2, 5, count)[None])
    return c.replace(prior=None, ratio=None, noise=None) if kind == "nothing" else c


@functools.cache
def real(i: int) -> Correspondences:
    """One of the real pairs of the test data, matches alone."""
    file = oracle("robust.npz")
    x0, x1 = (torch.from_numpy(file[f"{i:03d}.{field}"])[None] for field in ("X1", "X2"))
    return Correspondences(x0, x1, torch.ones(x0.shape[:2], dtype=torch.bool), key=torch.tensor([i]))


def quick_or_skip(name: str, *counts: int) -> Estimator:
    """`laws.quick`; skips the test where a library is not installed."""
    try:
        return quick(name, *counts)
    except ImportError as error:
        pytest.skip(str(error))


def models(pair: Pair, count: int) -> np.ndarray:
    """Models (count, 9) of eights of the pair's matches, which fit some others, and of none; the first is zero."""
    rng, F = np.random.default_rng(0), np.zeros((count, 9))
    F[1:] = rng.normal(size=(count - 1, 9))
    for k in range(2, count, 2):
        eight = np.ascontiguousarray(pair.points[:, rng.permutation(pair.count)[:8]])
        weighted_eight_point(eight, np.ones(eight.shape[1]), F[k])
    return F


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


class Residuals(NamedTuple):
    """Of n matches under one model: as they are, and bounds of what rounding makes of them."""

    exact: Array
    low: Array
    high: Array


def residuals(F: Array, pair: Pair, threshold: float, dtype: type[np.floating] = np.float32) -> Residuals:
    """Sampson distances in thresholds (n,) to a model (9,), each match's threshold by its noise.
    dtype: of points and model, and in which the bounds allow to compute."""
    points, A = (x.astype(dtype).astype(np.float64) for x in (pair.points, F.reshape(3, 3)))
    scale = pair.pixels_per_noise / threshold
    rounding = np.finfo(dtype).eps / (2 if dtype is np.float32 else 1)  # in float64 what is exact is rounded, too
    exact = np.abs(sampson(A, points[:2].T, points[2:].T))
    h0, h1 = np.vstack([points[:2], np.ones(pair.count)]), np.vstack([points[2:], np.ones(pair.count)])
    error = np.abs((h1 * (A @ h0)).sum(0))
    slope = np.sqrt(((A @ h0)[:2] ** 2).sum(0) + ((A.T @ h1)[:2] ** 2).sum(0))
    terms = (np.abs(h1) * (np.abs(A) @ np.abs(h0))).sum(0)
    rows = np.sqrt(((np.abs(A) @ np.abs(h0))[:2] ** 2).sum(0) + ((np.abs(A).T @ np.abs(h1))[:2] ** 2).sum(0))
    last = 1 + LAST * rounding
    off, slope_off = SUMS * rounding * terms, ROW * rounding * rows
    low = np.maximum(error - off, 0) / (slope + slope_off) / last
    high = np.where(slope > slope_off, (error + off) / np.maximum(slope - slope_off, 1e-300) * last, np.inf)
    return Residuals(exact * scale, low * scale, high * scale)
