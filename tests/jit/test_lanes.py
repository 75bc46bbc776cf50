"""Values of lanes: a kernel compiled does what the same function does to arrays, to the bit."""

import gc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fmtorch.jit import cache, linking
from fmtorch.jit import kernel as switch
from fmtorch.jit.kernel import B1x2, F4x2, F8x1, F8x2, kernel
from fmtorch.jit.lanes import LANES, absolute, added, any_lane, copysign, fill, lanes, load, sqrt, store, where
from tests.jit.test_kernels import load as load_module

pytestmark = pytest.mark.skipif(switch.off(), reason="kernels are switched off")
SINGLES = 16
load_singles, fill_singles = lanes(SINGLES)


@kernel
def in_doubles(values: F8x2, out: F8x2, masks: B1x2, sums: F8x1):
    """Every operator and function of lanes, of float64."""
    x, y, z = load(values, 0), load(values, 1), load(values, 2)
    total = fill(0.0)
    for row in range(len(values)):
        total += load(values, row) * load(values, row)
    store(out, 0, x + 2 * y - z / 3.0)
    store(out, 1, sqrt(total))
    store(out, 2, where((x < y) & ~(z >= 0.1) | (x != x), copysign(x, z), -absolute(y)))
    store(out, 3, 1.0 / x)
    store(out, 4, where(x == y, 5.0, z))
    total -= x
    total *= y
    total /= z
    store(out, 5, total)
    store(masks, 0, (x <= y) ^ (x > z))
    mask = load(masks, 0)
    mask &= y > z
    mask |= x >= z
    store(masks, 1, mask)
    sums[0], sums[1], sums[2], sums[3] = added(y), added(x), any_lane(y != y), any_lane(x != x)


@kernel
def in_singles(values: F4x2, out: F4x2, sums: F8x1):
    """Of float32, which stay so beside a number of float32."""
    x, y = load_singles(values, 0), load_singles(values, 1)
    store(out, 0, np.float32(0.1) * x + y / (x + np.float32(3)))
    store(out, 1, where(x > y, fill_singles(np.float32(2)), sqrt(absolute(y))))
    sums[0] = added(x * y)


def _rows(count, dtype):
    values = np.random.default_rng(0).normal(size=(3, count)).astype(dtype)
    values[0, :5] = [np.nan, np.inf, -np.inf, -0.0, values[1, 4]]
    return values


def same_compiled(kernel, values, *outputs):
    """The outputs of a kernel, which are those of its function interpreted."""
    compiled, plain = ([each.copy() for each in outputs] for _ in range(2))
    kernel(values, *compiled)
    kernel.function(values, *plain)
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a, b)
    return compiled


@pytest.mark.filterwarnings("ignore:divide by zero|invalid value:RuntimeWarning")
def test_compiled_operators_do_to_each_lane_what_they_do_to_arrays() -> None:
    outputs = np.zeros((6, LANES)), np.zeros((2, LANES), np.bool_), np.zeros(4)
    _, masks, _ = same_compiled(in_doubles, _rows(LANES, np.float64), *outputs)
    assert masks.any()
    assert not masks.all()


def test_float32_stays_float32() -> None:
    values = _rows(SINGLES, np.float32)
    values[0, :5] = [1, 2, 3, 4, 5]
    same_compiled(in_singles, values, np.zeros((2, SINGLES), np.float32), np.zeros(1))


def test_lanes_of_different_kinds_do_not_mix() -> None:
    @kernel
    def mixed(a: F8x2, b: F4x2):
        store(a, 0, load(a, 0) + load_singles(b, 0))

    for _ in range(2):  # the second compilation does not wait for the lock of the first
        with pytest.raises(numba.TypingError, match="lanes"):
            mixed(np.zeros((1, LANES)), np.zeros((1, SINGLES), np.float32))


def test_an_operator_leaves_other_names_of_a_value_as_they_were() -> None:
    total = start = fill(1.0)
    total += 1.0
    total *= 3.0
    assert (start.tolist(), total.tolist()) == ([1.0] * LANES, [6.0] * LANES)


numba = pytest.importorskip("numba", reason="numba is not installed")
SOURCE = """
import gc
from fmtorch.jit.kernel import F8x1
from fmtorch.jit.kernel import matrix, vector
from fmtorch.jit.kernel import inner, kernel

@inner
def fibonacci(n):
    return 1 if n < 2 else fibonacci(n - 1) + fibonacci(n - 2)

@inner
def positive(n):
    if n < 0:
        raise ValueError("a negative number")
    return n

@kernel
def sums(n: int, out: F8x1) -> int:
    count = fibonacci(positive(n))
    room, wide = vector(n), matrix(2, n)
    for i in range(n):
        room[i], wide[1, i] = i, 2 * i
        out[i] = room[i] + wide[1, i]
    return count
"""


@pytest.fixture(autouse=True)
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("FMTORCH_CACHE", str(tmp_path / "cache"))
    cache.folder.cache_clear()
    linking.inner_compiler.cache_clear()
    yield
    cache.folder.cache_clear()
    linking.inner_compiler.cache_clear()


def test_one_is_compiled_into_a_kernel(tmp_path: Path) -> None:
    """Recursion, exceptions and scratch arrays; from the folder, too."""
    for _ in range(2):
        module, out = load_module(tmp_path, SOURCE), np.zeros(10)
        assert (module.sums(10, out), out.tolist()) == (89, [3 * i for i in range(10)])
        with pytest.raises(ValueError, match="a negative number"):
            module.sums(-1, out)


def test_the_installed_numba_has_the_private_names(tmp_path: Path) -> None:
    module = load_module(tmp_path, SOURCE)
    module.sums(2, np.zeros(2))
    (result,) = module.positive._dispatcher.overloads.values()
    assert type(result.library).__name__ == "InnerLibrary"
    assert result.library.get_pointer_to_function(result.fndesc.llvm_func_name) == 0


def test_garbage_is_collected_afterwards_as_before(tmp_path: Path) -> None:
    for collects in (False, True):
        (gc.enable if collects else gc.disable)()
        try:
            load_module(tmp_path, SOURCE).sums(1, np.zeros(1))
            assert gc.isenabled() == collects
        finally:
            gc.enable()
