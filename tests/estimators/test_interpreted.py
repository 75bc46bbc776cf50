"""FMTORCH_KERNELS=off: the same functions interpreted by Python, for the debugger and for coverage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmtorch import presets
from fmtorch.compiling import switch
from fmtorch.core.types import Estimate
from tests.laws import few, scene
from tests.processes import run_command


def estimated(name: str) -> Estimate:
    """Of 40 matches, by few samples."""
    options = few(presets.load("estimator", name), hypotheses=20, round=10)
    if "focal" in options:
        options["focal"] = {"samples": 8, "rounds": 1, "min_rounds": 1, "pool": 4, "candidates": 4}
    found: Estimate = presets.build("estimator", name, **options)(scene(0, 40))
    return found


def save(name: str, path: str) -> None:
    """The estimate in a file, and whether kernels were interpreted."""
    estimate = estimated(name)
    fields = {field: getattr(estimate, field).numpy() for field in ("F", "inliers", "ok", "draws")}
    np.savez(path, off=switch.off(), **fields)


@pytest.mark.parametrize("name", ["msac", "fmtorch"])
def test_estimates_are_those_of_compiled_kernels(name: str, tmp_path: Path) -> None:
    path, compiled = tmp_path / "interpreted.npz", estimated(name)
    code = f"from {__name__} import save; save({name!r}, {str(path)!r})"
    ended = run_command("-c", code, cwd=tmp_path, environment={switch.SWITCH: "off"})
    assert ended.returncode == 0, ended.stderr
    assert "compiling" not in ended.stderr + ended.stdout
    with np.load(path) as interpreted:
        assert interpreted["off"]
        assert compiled.ok.tolist() == interpreted["ok"].tolist() == [True]
        assert compiled.draws.tolist() == interpreted["draws"].tolist()
        np.testing.assert_array_equal(interpreted["inliers"], compiled.inliers)
        # What is left apart: sums in lanes, and products that are fused. F has norm one.
        np.testing.assert_allclose(interpreted["F"], compiled.F, rtol=0, atol=1e-9)
