"""Inner functions are compiled without machine code of their own, by private names of numba that may go."""

import gc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fmtorch.jit import cache, linking
from tests.jit.test_kernels import load

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
        module, out = load(tmp_path, SOURCE), np.zeros(10)
        assert (module.sums(10, out), out.tolist()) == (89, [3 * i for i in range(10)])
        with pytest.raises(ValueError, match="a negative number"):
            module.sums(-1, out)


def test_the_installed_numba_has_the_private_names(tmp_path: Path) -> None:
    module = load(tmp_path, SOURCE)
    module.sums(2, np.zeros(2))
    (result,) = module.positive._dispatcher.overloads.values()
    assert type(result.library).__name__ == "InnerLibrary"
    assert result.library.get_pointer_to_function(result.fndesc.llvm_func_name) == 0


def test_garbage_is_collected_afterwards_as_before(tmp_path: Path) -> None:
    for collects in (False, True):
        (gc.enable if collects else gc.disable)()
        try:
            load(tmp_path, SOURCE).sums(1, np.zeros(1))
            assert gc.isenabled() == collects
        finally:
            gc.enable()
