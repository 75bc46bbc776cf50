"""One search for every generator: models belong to their draws, the best are kept, and the earlier of equals."""

from __future__ import annotations

import pytest
import torch

from fmtorch.core.types import collate
from fmtorch.estimators.models import Models, Pool
from fmtorch.estimators.options import Preselect
from fmtorch.estimators.pairs import NormalizedPairs, normalized_pairs
from fmtorch.estimators.pool import Verifier
from fmtorch.estimators.sampling import Prosac, Uniform
from fmtorch.estimators.scores import TruncatedSquares
from fmtorch.estimators.search import Search
from fmtorch.estimators.solvers import EightPoint, MinimalSamples, SevenPoint, Solver
from tests.laws import scene


def _pairs() -> NormalizedPairs:
    return normalized_pairs(collate([scene(i, 300) for i in range(3)]), 0, 8)[0][0]


@pytest.mark.parametrize("solver", [SevenPoint(), EightPoint()])
@pytest.mark.parametrize("sampler", [Uniform(), Prosac()])
def test_models_belong_to_the_samples_of_their_draws(solver: Solver, sampler: Uniform | Prosac) -> None:
    pairs = _pairs()
    models = MinimalSamples(solver, sampler)(pairs, 40, 30)
    assert int(models.valid.sum()) > 15
    assert bool((models.draw >= 40).all() & (models.draw < 70).all())
    for m in range(models.F.shape[2]):
        sample = models.sample_of(models.draw[:, m])
        points = torch.stack([pairs.points32.gather(2, i[:, None].expand(4, -1, 1)) for i in sample], 1)
        again, _ = solver(points)
        same = (again == models.F[..., m : m + 1]).all(0).any(1)
        assert bool(same[models.valid[:, m]].all())


def test_verified_models_keep_draws_and_samples() -> None:
    pairs = _pairs()
    models = MinimalSamples(SevenPoint(), Uniform())(pairs, 0, 200)
    few = Verifier(TruncatedSquares(1.0), Preselect(matches=64, survivors=20))(models, pairs)
    assert few.F.shape[2] == 20
    assert few.score is not None
    assert bool((few.draw.diff(dim=1) >= 0).all())
    every = Verifier(TruncatedSquares(1.0), None)(models, pairs)
    assert every.score is not None
    for p in range(3):
        for F, draw, score in zip(few.F[:, p].T, few.draw[p], few.score[p], strict=True):
            same = (every.F[:, p].T == F).all(1) & (every.draw[p] == draw)
            assert bool((every.score[p][same] == score).all())
            assert bool(same.any())


def test_a_pool_keeps_the_best_and_the_earlier_of_equals() -> None:
    pool = Pool.empty(1, 3, torch.device("cpu"))

    def offer(scores: list[float], first: int) -> None:
        F = torch.arange(first, first + len(scores)).float().expand(9, 1, -1).contiguous()
        none = torch.zeros(7, 1, 1, dtype=torch.int64)
        draw = torch.zeros(1, len(scores), dtype=torch.int64)
        valid = torch.ones(1, len(scores), dtype=torch.bool)
        pool.merge(torch.tensor([0]), Models(F, valid, draw, none, 0, torch.tensor([scores])))

    offer([1.0, 3.0], 10)
    assert pool.valid.tolist() == [[True, True, False]]
    offer([3.0, 2.0, 0.0], 20)
    assert pool.score.tolist() == [[3.0, 3.0, 2.0]]
    assert pool.F[0].tolist() == [[11.0, 20.0, 21.0]]


def test_pairs_that_are_confident_are_left_alone() -> None:
    pairs = _pairs()
    asked: list[int] = []

    def confident(F: torch.Tensor, draws: torch.Tensor, some: NormalizedPairs) -> list[bool]:
        asked.append(len(some))
        return [int(row) == 1 for row in some.row]  # the second pair, at once

    generator, verify = MinimalSamples(SevenPoint(), Uniform()), Verifier(TruncatedSquares(1.0), None)
    pool = Search(generator, verify, 4, 150, 50, confident)(pairs)
    assert asked == [3, 2]
    assert pool.draws.tolist() == [150, 50, 150]
    whole = Search(generator, verify, 4, 150, 50)(pairs)
    assert torch.equal(pool.F[:, [0, 2]], whole.F[:, [0, 2]])


def test_what_a_part_keeps_follows_the_pairs() -> None:
    pairs = _pairs()
    whole = pairs.once("hash", lambda: pairs.key[:, None] + pairs.slot)
    some = pairs.only([0, 2])
    assert torch.equal(some.once("hash", lambda: pytest.fail("computed again")), whole[[0, 2]])
    assert pairs.only([0, 1, 2]) is pairs
    near = pairs.take(torch.arange(5).expand(3, -1), pairs.mask)
    assert not near.kept
