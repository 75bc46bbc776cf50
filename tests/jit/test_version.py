"""Versions of compiled functions: what they depend on, what not, and that every process tells the same."""

import sys
import types
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fmtorch.estimators import WITH_FOCALS
from fmtorch.jit.cache import version
from fmtorch.jit.kernel import F4x1, F8x1, F8x2, U1x1, kernel, signature_of
from tests.processes import run_command

SOURCE = """
import enum
import math
import numpy as np
from typing import NamedTuple
from fmtorch.jit.kernel import F8x2
from fmtorch.jit.kernel import inner, kernel
from fmtorch.jit.lanes import LANES, fill, lanes, load

SCALE, TABLE, NAMES = 2.0, np.arange(3.0), ("a", "b")

class Kind(enum.IntEnum):
    FIRST = 1

class Pair(NamedTuple):
    first: float
    second: float = 1.0

@inner
def deepest(x):
    return x * SCALE

@inner
def deep(x, by=3):
    return deepest(x) + by + Kind.FIRST

def doubled(function):
    @inner
    def twice(x):
        return 2 * function(x)

    return twice

twice = doubled(deep)
wide = lanes(16)

class Group(NamedTuple):
    low: float
    high: float

@kernel
def callee(x: float) -> float:
    return x + 1

@kernel
def of_group(group: Group) -> float:
    return group.low

@kernel
def all_of_them(x: float, rows: F8x2) -> float:
    "What it does."
    pair = Pair(callee(x), TABLE[0])
    total = fill(0.0) + load(rows, 0)
    return twice(x) + math.sqrt(pair.first) + np.float64(LANES) + of_group(Group(x, x))

@kernel
def other(x: float) -> float:
    return x + 5
"""
CONSTANTS = ["{0.5, 1, 1.0, True}", "frozenset({'a', 'b', 'c'})", "{'b': 1, 'a': (2, None)}", "np.float32(2)", "2",
             "2.0", "1j", "True", "b'2'", "'2'", "np.zeros(2)", "np.zeros((2, 1))", "np.zeros((1, 2), order='F')",
             "np.dtype('f4')", "np.float64", "[2]", "(2,)", "np.sqrt", "np", "len", "math.inf"]  # fmt: skip


def load(folder: Path, source: str) -> types.ModuleType:
    """A module of this source, compiled here: bytecode on disk is only as new as a second and a file's size tell."""
    module = types.ModuleType("kernels_of_a_test")
    module.__file__ = str(folder / "kernels_of_a_test.py")
    sys.modules["kernels_of_a_test"] = module
    exec(compile(source, module.__file__, "exec"), vars(module))
    return module


def versions(folder: Path, source: str) -> dict[str, str]:
    module = load(folder, source)
    return {name: getattr(module, name).version for name in ("callee", "of_group", "all_of_them", "other")}


@pytest.mark.parametrize(
    ("old", "new", "changed"),
    [
        ("SCALE, TABLE, NAMES = 2.0", "SCALE, TABLE, NAMES = 2.5", {"all_of_them"}),  # of an inner function's inner one
        ("np.arange(3.0)", "np.arange(4.0)", {"all_of_them"}),
        ("x * SCALE", "x / SCALE", {"all_of_them"}),
        ("by=3", "by=4", {"all_of_them"}),
        ("FIRST = 1", "FIRST = 2", {"all_of_them"}),
        ("2 * function(x)", "3 * function(x)", {"all_of_them"}),  # within a closure
        ("twice = doubled(deep)", "twice = doubled(deepest)", {"all_of_them"}),  # in a cell of one
        ("second: float = 1.0", "second: float = 1.5", {"all_of_them"}),
        ("math.sqrt", "math.exp", {"all_of_them"}),
        ("load(rows", "wide.load(rows", {"all_of_them"}),
        ("x: float, rows: F8x2", "x: np.float32, rows: F8x2", {"all_of_them"}),
        ("low: float\n    high: float", "high: float\n    low: float", {"of_group", "all_of_them"}),
        ("x + 5", "x + 6", {"other"}),
        ("x + 1", "x + 2", {"callee"}),  # which others call through its address
        ("callee(x: float) -> float", "callee(x: np.float32) -> float", {"callee", "all_of_them"}),
        ("callee(x: float) -> float", "callee(x: float) -> int", {"all_of_them"}),
        ("@kernel\ndef callee", "@kernel(holds_gil=True)\ndef callee", {"callee"}),
        ("What it does.", "What else it does.", set()),
        ("SCALE, TABLE", "# a comment\n\nSCALE, TABLE", set()),
        ('("a", "b")', '("a", "c")', set()),  # which nobody uses
    ],
)
def test_it_changes_with_what_a_kernel_reaches(tmp_path: Path, old: str, new: str, changed: set[str]) -> None:
    assert SOURCE.count(old) == 1
    before, after = versions(tmp_path, SOURCE), versions(tmp_path, SOURCE.replace(old, new))
    assert {name for name in before if before[name] != after[name]} == changed


def test_it_changes_with_what_is_named_by_its_module(tmp_path: Path) -> None:
    """``module.function(x)`` reaches the function, and nothing else of the module."""
    versions = {}
    for scale, other in (("2.0", "1"), ("3.0", "1"), ("2.0", "2")):
        text = SOURCE.replace("= 2.0", f"= {scale}", 1).replace("x + 5", f"x + {other}")
        module = types.ModuleType("a_user")
        vars(module)["kernels_of_a_test"] = load(tmp_path, text)
        exec("def f(x):\n    return kernels_of_a_test.deepest(x)", vars(module))
        versions[scale, other] = version(module.f)
    assert versions["2.0", "1"] != versions["3.0", "1"]
    assert versions["2.0", "1"] == versions["2.0", "2"]


def of_constants(folder: Path) -> dict[str, str]:
    text = "import math, numpy as np\n" + "".join(
        f"\nV{i} = {value}\ndef f{i}():\n    return V\nf{i} = type(f{i})(f{i}.__code__, dict(V=V{i}, __name__='m'))\n"
        for i, value in enumerate(CONSTANTS)
    )
    module = load(folder, text)
    return {value: version(getattr(module, f"f{i}")) for i, value in enumerate(CONSTANTS)}


def test_every_constant_counts_by_its_value_and_type(tmp_path: Path) -> None:
    versions = of_constants(tmp_path)
    assert (len(set(versions.values())), of_constants(tmp_path)) == (len(CONSTANTS), versions)


def test_names_beyond_the_first_bytes(tmp_path: Path) -> None:
    """A module may have more names than one argument of an instruction can count."""
    names = [f"name{i}" for i in range(400)]
    text = "\n".join(f"{name} = {i}" for i, name in enumerate(names)) + f"\ndef f():\n    return {' + '.join(names)}\n"
    changed = (text.replace(f"name{i} = {i}\n", f"name{i} = -1\n") for i in range(0, 399, 7))
    assert len({version(load(tmp_path, each).f) for each in changed}) == 57


@pytest.mark.parametrize("value", ["object()", "sys.modules['tests.conftest'].oracle"])
def test_what_has_no_version_is_refused_by_name(tmp_path: Path, value: str) -> None:
    module = load(tmp_path, f"import sys\nLIMIT = {value}\ndef f():\n    return LIMIT\n")
    with pytest.raises(TypeError, match=r"kernels_of_a_test\.f uses LIMIT: .*version"):
        version(module.f)


def test_every_process_tells_the_same_versions(tmp_path: Path) -> None:
    code = "from fmtorch.estimators import WITH_FOCALS; print(*(each.version for each in WITH_FOCALS))"
    printed = run_command("-c", code, cwd=tmp_path).stdout  # whose hashes of strings are others
    here = [each.version for each in WITH_FOCALS]  # with the checks that tests wrap around functions
    assert (printed.split(), len(set(here))) == (here, len(here))


CLASHING = """
from fmtorch.jit.kernel import inner, kernel

def summed(first):
    @inner
    def recursive(n):
        return first(n) if n < 2 else recursive(n - 1) + recursive(n - 2)

    return recursive

@inner
def one(n):
    return 1

@inner
def ten(n):
    return 10

ones, tens = summed(one), summed(ten)

@kernel
def of_ones(n: int) -> int:
    return ones(n)

@kernel
def of_tens(n: int) -> int:
    return tens(n)
"""


def test_functions_of_one_name_kept_by_two_processes_stay_two(tmp_path: Path) -> None:
    """numba tells functions of one name apart by numbers that begin anew in every process."""
    (tmp_path / "clashing.py").write_text(CLASHING)
    own = {"FMTORCH_CACHE": str(tmp_path / "own")}
    calls = ("of_ones(5)", "of_tens(5)", "of_ones(5), of_tens(5)", "of_tens(5), of_ones(5)")
    codes = [f"from clashing import *; print({each})" for each in calls]
    printed = [run_command("-c", code, cwd=tmp_path, environment=own).stdout.split() for code in codes]
    assert printed == [["8"], ["80"], ["8", "80"], ["80", "8"]]


numba = pytest.importorskip("numba", reason="numba is not installed")


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


SCRIPT = """
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


def test_a_script_finds_what_it_kept_although_its_groups_are_made_anew(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    own, code = {"FMTORCH_CACHE": str(tmp_path)}, "import runpy; runpy.run_path('script.py', run_name='__main__')"
    done = [run_command("-c", code, cwd=tmp_path, environment=own) for _ in range(2)]
    assert [each.stdout for each in done] == ["6.0\n"] * 2
    assert ["compiling end" in each.stderr for each in done] == [True, False]
