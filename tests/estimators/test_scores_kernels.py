"""Scores and pools by kernels against the tensor form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fmtorch.estimators.models import Models, Pool
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.saturated_gains import SaturatedGains
from fmtorch.estimators.scores import (
    GemanMcClure,
    InlierCount,
    Median,
    SigmaConsensus,
    TruncatedSquares,
    score_models,
)

from fmtorch.estimators import pool_kernels, scores_kernels
from fmtorch.geometry import eight_point
from fmtorch.geometry.residuals import sampson_squared
from tests.laws import degenerate, scene

pytest.importorskip("numba", reason="numba is not installed")

BITS = 10
NONE = np.empty(0, np.float32)
GAINS = {
    "count": (scores_kernels.COUNT, InlierCount),
    "squares": (scores_kernels.TRUNCATED_SQUARES, TruncatedSquares),
    "geman_mcclure": (scores_kernels.GEMAN_MCCLURE, GemanMcClure),
    "magsac": (scores_kernels.TABLE, SigmaConsensus),
}


def normalized(count: int, noise: bool, kind: str = "") -> NormalizedPairs:
    c = degenerate()[kind] if kind else scene(count, count)
    if noise:
        c = c.replace(noise=torch.linspace(0.2, 5, c.mask.shape[1])[None])
    (made,), _ = normalized_pairs(c, 0, 7)
    return made


def models(pair: NormalizedPairs, count: int) -> np.ndarray:
    """Models of random eights, which fit some of the matches, and a zero one."""
    n = int(pair.count[0])
    index = np.random.default_rng(0).integers(0, n, (count, 8))
    points = pair.points[:, 0, index].permute(1, 2, 0)
    F, _ = eight_point(points[..., :2], points[..., 2:])
    F[0] = 0
    return F.flatten(1).float().numpy()


def arrays(pair: NormalizedPairs, threshold: float, weighted: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = int(pair.count[0])
    points = np.ascontiguousarray(pair.points[:, 0, :n].float().numpy())
    support = np.ones(n, np.float32)
    if weighted:
        assert pair.prior is not None
        support = pair.prior[0, :n].float().numpy()
    scale = (pair.scale / threshold).square().float().expand(1, pair.mask.shape[1])[0, :n].contiguous().numpy()
    return points, support, scale


CASES = [
    (150, False, ""),
    (700, False, ""),
    (700, True, ""),
    (8, False, ""),
    (0, False, "collinear"),
    (0, True, "identity"),
]


@pytest.mark.parametrize(("count", "noise", "kind"), CASES)
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("gain", GAINS)
def test_summed_gains(gain: str, weighted: bool, count: int, noise: bool, kind: str) -> None:
    pair = normalized(count, noise, kind)
    code, tensor_form = GAINS[gain]
    score = tensor_form(1.5)
    score.prior_weighted = weighted
    F = models(pair, 200)
    expected = score_models(score, torch.from_numpy(F).T[:, None], pair)[0].numpy()
    points, support, scale = arrays(pair, 1.5, weighted)
    table = score._table.numpy() if isinstance(score, SigmaConsensus) else NONE
    which, out = np.arange(200)[::-1].copy(), np.empty(200)
    scores_kernels.score_gains(F, which, points, support, scale, code, table, BITS, out)
    assert (out * 2**BITS == np.round(out * 2**BITS)).all()
    # float32 residuals are rounded differently where products are fused: a unit a match at most, a whole gain of a
    # match on the threshold. On average over the models they are the same.
    whole = 2.0 if gain in ("count", "magsac") else 0
    assert np.abs(out[::-1] - expected).max() <= len(support) / 8 * 2.0**-BITS + whole
    assert np.median(np.abs(out[::-1] - expected)) <= 2 * 2.0**-BITS


@pytest.mark.parametrize(("count", "noise", "kind"), CASES)
def test_saturated_gains(count: int, noise: bool, kind: str) -> None:
    pair = normalized(count, noise, kind)
    score = SaturatedGains(1.5)
    F = models(pair, 100)
    expected = score_models(score, torch.from_numpy(F).T[:, None], pair)[0].numpy()
    points, support, scale = arrays(pair, 1.5, True)
    cells, which, out = np.empty((2, len(support)), np.int32), np.arange(100), np.empty(100)
    scores_kernels.saturated_cells(points, support, cells)
    assert ((cells[0] >= 0) & (cells[0] < 144) & (cells[1] >= 144) & (cells[1] < 288)).all()
    scores_kernels.score_saturated(F, which, points, support, scale, cells, BITS, out)
    # A unit in the gain of a lone match is up to 16 units in its root at 2^-10 (the root of one unit is 32).
    assert np.abs(out - expected).max() <= 64 * 2.0**-BITS
    assert np.median(np.abs(out - expected)) <= 2 * 2.0**-BITS


@pytest.mark.parametrize("count", [8, 9, 150, 701])
def test_median(count: int) -> None:
    pair = normalized(count, False)
    F = models(pair, 100)
    expected = score_models(Median(), torch.from_numpy(F).T[:, None], pair)[0].numpy()
    points, _, _ = arrays(pair, 1.0, False)
    out = np.empty(100)
    scores_kernels.score_median(F, np.arange(100), points, out)
    # A residual of matches on the model is a difference of products of 1, rounded to 1e-7 each.
    np.testing.assert_allclose(np.sqrt(-out), np.sqrt(-expected), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("m", "k"), [(1, 1), (5, 5), (300, 96), (300, 1), (1000, 256)])
def test_the_best_of_a_round_and_of_a_search(m: int, k: int) -> None:
    rng = np.random.default_rng(m + k)
    score = rng.integers(0, 40, m) / 8.0  # many are equal
    which = np.empty(k, np.int64)
    pool_kernels.best(score, which)
    order = np.argsort(-score, kind="stable")[:k]
    np.testing.assert_array_equal(which, np.sort(order))
    F = rng.normal(size=(m, 9)).astype(np.float32)
    pool, pool_score, filled = np.zeros((12, 9), np.float32), np.empty(12), 0
    for some in np.array_split(which, 3):
        filled = pool_kernels.merge(F, some, score[some], filled, pool, pool_score)
    best, index = Pool.empty(1, 12, torch.device("cpu")), torch.from_numpy(which)
    best.merge(torch.tensor([0]), Models(
        torch.from_numpy(F)[index].T[:, None], torch.ones(1, k, dtype=torch.bool), index[None],
        torch.empty(0, 1, m, dtype=torch.int64), 0, torch.from_numpy(score)[index][None].float(),
    ))  # fmt: skip
    assert filled == min(12, k)
    np.testing.assert_array_equal(pool[:filled], best.F[:, 0, :filled].T.numpy())
    np.testing.assert_array_equal(pool_score[:filled], best.score[0, :filled].numpy())


def test_residuals_and_matches_near_a_pool() -> None:
    pair = normalized(300, False)
    F = models(pair, 20)[1:]
    points = np.ascontiguousarray(pair.points[:, 0, :300].numpy())
    squared = sampson_squared(torch.from_numpy(F).double().T[:, None].contiguous(), pair.points[..., :300])[0].numpy()
    out, weight = np.empty(300), np.arange(1, 301)
    for k in range(len(F)):
        pool_kernels.residuals_squared(F[k].astype(np.float64), points, 3.0, out)
        np.testing.assert_allclose(out, 3 * squared[k], rtol=1e-9, atol=1e-20)
        share = pool_kernels.share_within(F[k].astype(np.float64), points, 3.0, float(np.median(out)), weight)
        assert share == weight[out <= np.median(out)].sum() / weight.sum()
    near, limit, index = np.zeros(300, bool), np.float32(1e-4), np.empty(300, np.int64)
    near[index[: pool_kernels.near(F, points.astype(np.float32), limit, 1, 2, index)]] = True
    clear = np.abs(squared.min(0) / limit - 1) > 1e-2  # not on the limit
    np.testing.assert_array_equal(near[clear], (squared.min(0) <= limit)[clear])
    assert 0 < near.sum() < 300


@pytest.mark.parametrize("kind", ["equal", "tiny and huge", "some zero"])
def test_median_of_unusual_residuals(kind: str) -> None:
    """x1' F x0 = y1 - y0 for F of rectified images, so that residuals are half of (y1 - y0)^2."""
    n = 101
    apart = {"equal": np.full(n, 0.5), "tiny and huge": 10.0 ** np.linspace(-15, 15, n)}.get(kind, np.arange(n) // 60.0)
    points = np.zeros((4, n), np.float32)
    points[3] = np.random.default_rng(0).permutation(apart)
    F, out = np.array([[0, 0, 0, 0, 0, 1, 0, -1, 0]], np.float32), np.empty(1)
    scores_kernels.score_median(F, np.zeros(1, np.int64), points, out)
    assert -out[0] == pytest.approx(np.sort(points[3].astype(np.float64) ** 2 / 2)[(n + 1) // 2 - 1], rel=1e-6)
