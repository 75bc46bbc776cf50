"""Checks of the compiled engine, run as a program: torch.compile cannot trace the tests' run-time checks of types."""

from __future__ import annotations

import torch

from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.compiled import CompiledScore, CompiledSolver
from fmtorch.estimators.parts import SevenPoint
from fmtorch.estimators.problem import problems
from fmtorch.estimators.scoring import TruncatedSquares
from fmtorch.types import collate
from tests.laws import assert_same, scene


def compiled_score_and_solver_equal_the_eager_ones() -> None:
    problem = problems(scene(0, 150), 0, 8)[0][0]
    points = problem.points.float()
    index = torch.rand(40, 150, generator=torch.Generator().manual_seed(0)).argsort(1)[:, :7].T
    sample = points[:, :, index].movedim(1, 2)
    F, valid = SevenPoint()(sample)
    G, compiled_valid = CompiledSolver(SevenPoint())(sample)
    both = valid & compiled_valid
    assert (valid == compiled_valid).double().mean() > 0.95  # double roots may fall either way
    # float32 null vectors: relative error 1e-7 times the condition of a sample
    assert ((F - G).abs().amax(0)[both] < 1e-3).double().mean() > 0.95
    score, weight = TruncatedSquares(2.0), problem.live.float()
    eager = score(F, points, weight, problem.unit)
    compiled = CompiledScore(score)(F, points, weight, problem.unit)
    # Each of 150 gains is rounded to 2^-10 and its residual to 1e-7 times the cancellation in x1^T F x0.
    assert ((eager - compiled).abs() < 150 * 2.0**-10).all()


def compiled_estimates_do_not_depend_on_their_batch() -> None:
    estimator = HypothesizeAndVerify(hypotheses=60, round=30, preselect=32, survivors=20, compile=True)
    pairs = [scene(i, count) for i, count in enumerate((150, 40, 190))]
    together = estimator(collate(pairs), seed=5)
    for i, pair in enumerate(pairs):
        alone = estimator(pair, seed=5)
        assert_same({"F": alone.F}, {"F": together.F[i : i + 1]}, f"pair {i}")


if __name__ == "__main__":
    compiled_score_and_solver_equal_the_eager_ones()
    compiled_estimates_do_not_depend_on_their_batch()
