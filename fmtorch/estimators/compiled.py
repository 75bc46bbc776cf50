"""The engine's score, compiled: an option for long runs, paid for with a start of some ten seconds a shape."""

from __future__ import annotations

import os
import shutil
import sysconfig
from pathlib import Path

import torch
from torch import Tensor

from fmtorch.estimators.scoring import Score, SummedGains


class CompiledScore:
    """A score through torch.compile: residuals, gains and their sum in one pass.

    Without the fused multiply-add of the eager score, so that residuals differ in the last bit and some scores by a few
    2^-10. Its code is arithmetic on single numbers and a sum that is exact in any order.
    """

    def __init__(self, score: SummedGains) -> None:
        require_compiler()
        self.prior_weighted = score.prior_weighted
        self._compiled = torch.compile(score.__call__, dynamic=True)

    def __call__(self, F: Tensor, points: Tensor, weight: Tensor, unit: Tensor) -> Tensor:
        """As `Score`."""
        scores: Tensor = self._compiled(F, points, weight, unit)
        return scores


def compiled(score: Score) -> Score:
    """The score compiled; a median stays as it is, since selecting it is no arithmetic."""
    return CompiledScore(score) if isinstance(score, SummedGains) else score


def require_compiler() -> None:
    """Raise RuntimeError, saying what is missing, where torch.compile could not build code for the processor."""
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler) is None:
        raise RuntimeError(
            f"compile=true needs a C++ compiler, and there is no {compiler!r} on the path: install one, name it in the "
            "environment variable CXX, or leave compile=false"
        )
    headers = Path(sysconfig.get_paths()["include"])
    if not (headers / "Python.h").exists():
        raise RuntimeError(
            f"compile=true needs Python's headers, and there is no Python.h in {headers}: install them (python3-dev), "
            "or leave compile=false"
        )
