"""Signatures are read from annotations: arrays, numbers, and groups of them."""

import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fmtorch.jit.kernel import F4x1, F8x1, F8x2, U1x1, kernel, signature_of

numba = pytest.importorskip("numba", reason="numba is not installed")
REPOSITORY = Path(__file__).resolve().parents[2]


class Different(NamedTuple):
    x: F8x2
    code: U1x1
    count: int
    scale: float


class Alike(NamedTuple):
    x: F8x1
    y: F8x1


class Singles(NamedTuple):
    low: np.float32
    high: np.float32


@kernel
def of_groups(different: Different, alike: Alike, singles: Singles, out: F8x1) -> None:
    x, code, count, scale = different
    out[0] = x[0, 0] + code[0] + count + scale
    out[1] = alike.x[0] - alike.y[0]
    out[2] = singles.high - singles.low


def groups() -> tuple[Different, Alike, Singles]:
    different = Different(np.full((2, 2), 0.5), np.full(3, 200, np.uint8), 3, 0.25)
    return different, Alike(np.full(4, 7.0), np.full(5, 2.0)), Singles(np.float32(1), np.float32(1.5))


def test_kernels_take_groups_whose_members_are_different_or_alike() -> None:
    for function in (of_groups, of_groups.function):
        out = np.zeros(3)
        function(*groups(), out)
        assert out.tolist() == [203.75, 5.0, 0.5]


def test_what_does_not_fit_a_group_is_refused() -> None:
    different, alike, singles = groups()
    for wrong in (different._replace(scale=1), different._replace(x=np.zeros((2, 2), np.float32))):
        with pytest.raises(TypeError):
            of_groups(wrong, alike, singles, np.zeros(3))
    with pytest.raises(TypeError):
        of_groups(different, alike, Singles(1.0, 2.0), np.zeros(3))  # type: ignore[arg-type]


def test_an_annotation_that_is_no_type_of_kernels_is_named() -> None:
    class Wrong(NamedTuple):
        text: str

    def without(x: F4x1, y) -> None: ...  # type: ignore[no-untyped-def]

    def grouped(x: F4x1, group: object) -> None: ...

    grouped.__annotations__["group"] = Wrong
    with pytest.raises(TypeError, match=r"without: y is annotated None"):
        signature_of(without)
    with pytest.raises(TypeError, match=r"grouped: group\.text is annotated <class 'str'>"):
        signature_of(grouped)


def test_a_script_finds_what_it_kept_although_its_groups_are_made_anew(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        """
from typing import NamedTuple
import numpy as np
from fmtorch.jit.kernel import F8x1
from fmtorch.jit.kernel import kernel

class Line(NamedTuple):
    x: F8x1
    slope: float

@kernel
def end(line: Line) -> float:
    return line.x[-1] * line.slope

print(end(Line(np.arange(4.0), 2.0)))
"""
    )
    env = {**os.environ, "PYTHONPATH": str(REPOSITORY), "FMTORCH_CACHE": str(tmp_path / "cache")}
    compiled = []
    for _ in range(2):
        done = subprocess.run([sys.executable, str(script)], env=env, capture_output=True, text=True, check=True)
        assert done.stdout == "6.0\n"
        compiled.append("compiling end" in done.stderr)
    assert compiled == [True, False]
