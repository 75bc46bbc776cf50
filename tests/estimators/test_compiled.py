"""The compiled engine finds what the eager one finds, keeps the laws, and says what it lacks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fmtorch.estimators import HypothesizeAndVerify
from fmtorch.estimators.compiled import require_compiler


def test_compiled_parts_equal_the_eager_ones_and_keep_the_laws() -> None:
    try:
        require_compiler()
    except RuntimeError as error:
        pytest.skip(str(error))
    root = Path(__file__).parents[2]
    command = [sys.executable, "-m", "tests.estimators.compiled_checks"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_missing_compiler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(RuntimeError, match="needs a C\\+\\+ compiler, and there is no 'no-such-compiler'"):
        HypothesizeAndVerify(compile=True)
