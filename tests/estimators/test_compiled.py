"""The compiled engine finds what the eager one finds, keeps the laws, and says what it lacks."""

from __future__ import annotations

import pytest
import torch

from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.compiled import CompiledScore, CompiledSolver, require_compiler
from fmtorch.estimators.parts import SevenPoint
from fmtorch.estimators.problem import problems
from fmtorch.estimators.scoring import TruncatedSquares
from fmtorch.types import collate
from tests.laws import assert_same, scene


def _needs_compiler() -> None:
    try:
        require_compiler()
    except RuntimeError as error:
        pytest.skip(str(error))


def test_compiled_score_and_solver_equal_the_eager_ones() -> None:
    _needs_compiler()
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


def test_compiled_estimates_do_not_depend_on_their_batch() -> None:
    _needs_compiler()
    estimator = HypothesizeAndVerify(hypotheses=60, round=30, preselect=32, survivors=20, compile=True)
    pairs = [scene(i, count) for i, count in enumerate((150, 40, 190))]
    together = estimator(collate(pairs), seed=5)
    for i, pair in enumerate(pairs):
        alone = estimator(pair, seed=5)
        assert_same({"F": alone.F}, {"F": together.F[i : i + 1]}, f"pair {i}")


def test_a_missing_compiler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(RuntimeError, match="needs a C\\+\\+ compiler, and there is no 'no-such-compiler'"):
        HypothesizeAndVerify(compile=True)
