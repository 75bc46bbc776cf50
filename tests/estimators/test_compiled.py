"""The compiled score gives the eager one's numbers, to rounding, in any tile, and says what it lacks."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.compiled import CompiledScore, require_compiler
from fmtorch.estimators.problem import problems
from fmtorch.estimators.scoring import TruncatedSquares
from fmtorch.types import collate
from tests.laws import scene


def test_compiled_score_equals_the_eager_one_in_any_tile() -> None:
    try:
        require_compiler()
    except RuntimeError as error:
        pytest.skip(str(error))
    # In a process of its own: the tests' checks of types cannot be compiled.
    command = "from tests.estimators.test_compiled import check_compiled_score as check; check()"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def check_compiled_score() -> None:
    problem = problems(collate([scene(i, 180) for i in range(3)]), 0, 8)[0][0]
    F = torch.randn(9, 3, 40, generator=torch.Generator().manual_seed(0)) * torch.logspace(-2, 0, 9)[:, None, None]
    points, weight, unit = problem.points.float(), problem.live.float(), problem.units
    score = TruncatedSquares(2.0)
    compiled = CompiledScore(score)
    whole = compiled(F, points, weight, unit)
    # Each of 180 gains is rounded to 2^-10, and its residual to 1e-7 times the cancellation in x1^T F x0.
    assert ((whole - score(F, points, weight, unit)).abs() < 180 * 2.0**-10).all()
    for i in range(3):
        some = slice(i, i + 1)
        alone = compiled(F[:, some, 5:30], points[:, some], weight[some], unit[some])
        assert torch.equal(alone, whole[some, 5:30])


def test_a_missing_compiler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(RuntimeError, match="compiler, and there is no 'no-such-compiler'"):
        HypothesizeAndVerify(compile=True)
