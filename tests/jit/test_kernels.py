"""Compiled functions: made when first called, kept by version, refused where they do not fit, dispensable."""

import importlib.util
import os
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fmtorch.jit import cache as files
from fmtorch.jit import kernel as switch
from fmtorch.jit.kernel import Kernel, kernel
from fmtorch.jit.lanes import fused
from tests.helpers import full_disk, in_threads, write_file
from tests.processes import SOURCE as SOURCE_TREE
from tests.processes import run_command, starter

SOURCE = """
import numpy as np
from fmtorch.jit.kernel import F4x1, F4x2
from fmtorch.jit.kernel import inner, kernel

@inner
def square(x):
    return x * x

@kernel
def scaled_squares(x: F4x1, scale: float, out: F4x1) -> None:
    for i in range(len(x)):
        out[i] = np.float32(square(x[i]) * scale)

@kernel
def rows(x: F4x2, out: F4x2):
    for i in range(len(x)):
        scaled_squares(x[i], 2.0, out[i])
"""
WAITING = """
import numpy as np
from fmtorch.jit.kernel import I8x1
from fmtorch.jit.kernel import kernel

@kernel(holds_gil={holds_gil})
def answered(flags: I8x1, rounds: int):
    flags[0] = 1
    for _ in range(rounds):
        if flags[1]:
            return True
        np.empty(1)  # as far as the compiler knows, this may change the flags
    return False
"""
numba = pytest.importorskip("numba", reason="numba is not installed")
EXPECTED = [[2, 8], [18, 32]]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("FMTORCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv(switch.SWITCH, raising=False)
    monkeypatch.setitem(switch._state, "announced", False)
    files.folder.cache_clear()
    yield tmp_path / "cache" / "kernels"
    files.folder.cache_clear()


@pytest.fixture
def module(tmp_path: Path) -> types.ModuleType:
    return load(tmp_path)


def load(folder: Path, source: str = SOURCE) -> types.ModuleType:
    """A module of kernels, as in a process that has called none of them."""
    path = folder / "some_kernels.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location("some_kernels", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["some_kernels"] = module
    spec.loader.exec_module(module)
    return module


def result(module: types.ModuleType) -> list[list[float]]:
    x = np.array([[1, 2], [3, 4]], np.float32)
    out = np.zeros_like(x)
    module.rows(x, out)
    return out.tolist()


RETURNING = """
from fmtorch.jit.kernel import kernel

@kernel
def half(x: float){annotation}:
    return x / 2

@kernel
def quarter(x: float, sure: bool) -> float:
    return half(half(x)) if sure else x
"""


def test_kernels_compiled_in_any_order_and_loaded_call_one_another(tmp_path: Path, cache: Path) -> None:
    module = load(tmp_path, RETURNING.format(annotation=" -> float"))
    module.quarter.compiled_alone()
    assert not module.quarter.ready
    assert not module.half.kept
    assert module.quarter(8.0, True) == 2
    assert module.half.kept
    (folder,) = cache.iterdir()
    for path in folder.glob("*half-*.bin"):
        path.unlink()
    again = load(tmp_path, RETURNING.format(annotation=" -> float"))
    assert again.quarter(8.0, True) == 2
    assert again.half.kept


def test_what_does_not_fit_the_signature_is_refused(module: types.ModuleType) -> None:
    x = np.ones((2, 2), np.float32)
    module.scaled_squares(x[0], 2, x[1])  # an integer for a float will do
    for wrong in (x.astype(np.float64), np.asfortranarray(x), x[0], x[:, ::2]):
        with pytest.raises(TypeError):
            module.rows(wrong, x)
    assert len(module.scaled_squares.compiled().signatures) == 1
    assert module.square(3) == 9  # an inner function is also a plain one


def test_what_was_compiled_is_kept_and_reported_once(tmp_path, cache, capsys):
    assert result(load(tmp_path)) == EXPECTED
    messages = capsys.readouterr().err
    assert [line.split(" for ")[0] for line in messages.splitlines()] == ["compiling rows and what else is missing"]
    files = {path: path.stat().st_ino for path in cache.rglob("*.bin")}
    assert (len(files), result(load(tmp_path))) == (2, EXPECTED)
    assert capsys.readouterr().err == ""
    assert {path: path.stat().st_ino for path in cache.rglob("*.bin")} == files


@pytest.mark.parametrize("importable", [True, False])
def test_two_processes_compile_together(module, tmp_path, monkeypatch, cache, importable):
    """What the other process cannot compile is compiled here."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path) if importable else "")
    monkeypatch.setattr(switch, "cores", lambda: 2)
    both = [module.rows, module.scaled_squares]
    assert not any(each.ready or each.kept for each in both)
    switch.compile_together(both)
    assert all(each.ready and each.kept for each in both)
    assert (len(list(cache.rglob("*.bin"))), result(module)) == (2, EXPECTED)
    monkeypatch.setattr(switch, "_helped", None)  # is not asked again
    switch.compile_together(both)


def start_helper(folder: Path, kernel: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "fmtorch.jit.kernel", kernel]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SOURCE_TREE), str(folder)])}
    return subprocess.Popen(command, stdin=subprocess.PIPE, env=environment)


def test_the_other_process_compiles_what_it_is_given(module: types.ModuleType, tmp_path: Path) -> None:
    assert start_helper(tmp_path, "some_kernels:rows").wait(300) == 0
    assert module.rows.kept
    assert not module.scaled_squares.kept


def test_the_other_process_ends_with_the_one_that_asked(tmp_path: Path) -> None:
    (tmp_path / "endless.py").write_text("import time\ntime.sleep(300)\n")
    helper = start_helper(tmp_path, "endless:rows")
    helper.stdin.close()
    assert helper.wait(60) == 1


def test_the_folder_depends_on_what_decides_the_machine_code(monkeypatch: pytest.MonkeyPatch) -> None:
    before = files.folder()
    monkeypatch.setattr(numba, "__version__", "9.9.9")
    files.folder.cache_clear()
    assert files.folder() != before


def test_fused_arithmetic_rounds_once_compiled_and_not(tmp_path: Path) -> None:
    source = """
from fmtorch.jit.kernel import F4x1
from fmtorch.jit.lanes import fused
from fmtorch.jit.kernel import kernel

@kernel
def all_fused(a: F4x1, b: F4x1, c: F4x1, out: F4x1):
    for i in range(len(a)):
        out[i] = fused(a[i], b[i], c[i])
"""
    a, b, c = np.random.default_rng(0).normal(0, 1, (3, 2000)).astype(np.float32)
    out = np.empty_like(a)
    load(tmp_path, source).all_fused(a, b, c, out)
    np.testing.assert_array_equal(out, [fused(*values) for values in zip(a, b, c, strict=True)])
    assert (out != a + b * c).any()


def test_kernels_that_a_function_makes_have_names_of_their_own() -> None:
    def multiplier(by: float, **options: str) -> Kernel[..., float]:
        @kernel(**options)
        def scaled(x: float) -> float:
            return x * by

        return scaled

    assert multiplier(2.0, name="doubled")(1.0) == 2
    assert multiplier(3.0, name="tripled")(1.0) == 3
    with pytest.raises(ValueError, match=r"two kernels are called .*doubled: make each with a name="):
        multiplier(4.0, name="doubled")


def test_a_damaged_file_is_compiled_anew(tmp_path: Path, cache: Path) -> None:
    result(load(tmp_path))
    for path in cache.rglob("*.bin"):
        path.write_bytes(path.read_bytes()[:-7])
    with pytest.warns(UserWarning, match="is damaged"):
        assert result(load(tmp_path)) == EXPECTED
    assert result(load(tmp_path)) == EXPECTED


def test_without_a_writable_cache_kernels_are_compiled_and_say_so(module, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("FMTORCH_CACHE", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="compiled kernels are not kept"):
        assert result(module) == EXPECTED
    assert "compiling rows and what else is missing for this process" in capsys.readouterr().err


def test_a_cache_that_can_only_be_read_is_used(tmp_path, monkeypatch, capsys):
    result(load(tmp_path))
    capsys.readouterr()
    files.folder.cache_clear()
    monkeypatch.setattr(Path, "write_text", full_disk)
    monkeypatch.setattr(Path, "write_bytes", full_disk)
    assert files.folder() is not None
    monkeypatch.undo()
    monkeypatch.setenv("FMTORCH_CACHE", str(tmp_path / "cache"))
    assert (result(load(tmp_path)), capsys.readouterr().err) == (EXPECTED, "")


def test_a_full_disk_costs_the_file_and_not_the_result(module, cache, monkeypatch):
    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.warns(UserWarning, match="No space left"):
        assert result(module) == EXPECTED
    assert not list(cache.rglob("*.bin*"))


def test_folders_long_unused_are_removed(cache: Path) -> None:
    for name, days in (("old", 31), ("recent", 29)):
        write_file(cache / name / files.ABOUT, "{}")
        then = time.time() - days * 24 * 3600
        os.utime(cache / name / files.ABOUT, (then, then))
    (cache / "of somebody else").mkdir()
    now = files.folder()
    assert {path.name for path in cache.iterdir()} == {"recent", "of somebody else", now.name}


def test_threads_compile_it_once_and_run_at_the_same_time(module, capsys):
    results: list[list[list[float]]] = []
    in_threads(4, lambda _: results.append(result(module)))
    assert (results, capsys.readouterr().err.count("compiling rows")) == ([EXPECTED] * 4, 1)


@pytest.mark.parametrize("holds_gil", [False, True])
def test_a_kernel_may_keep_the_lock_that_others_leave_to_other_threads(tmp_path: Path, holds_gil: bool) -> None:
    flags = np.zeros(2, np.int64)  # the kernel runs; a thread has seen that
    answered = load(tmp_path, WAITING.format(holds_gil=holds_gil)).answered
    answered(flags, 0)
    flags[:] = 0

    def answer() -> None:
        while not flags[0]:
            time.sleep(1e-4)
        flags[1] = 1

    thread = threading.Thread(target=answer)
    thread.start()
    assert answered(flags, 10**5 if holds_gil else 10**9) == (not holds_gil)
    thread.join()


def test_several_processes_compile_each_kernel_once(tmp_path: Path, cache: Path) -> None:
    here = tmp_path / "here"
    write_file(here / "some_kernels.py", SOURCE)
    code = (
        "import numpy as np, some_kernels as k\n"
        "from fmtorch.jit.cache import KernelFile\n"
        "compiled, plain = [], KernelFile.save_overload\n"
        "KernelFile.save_overload = lambda *arguments: (compiled.append(1), plain(*arguments))\n"
        "x = np.ones((1, 3), 'f4'); k.rows(x, x); print(len(compiled), x.tolist())"
    )
    told = {"environment": {"FMTORCH_CACHE": str(cache.parent)}, "errors": here / "errors"}
    commands = [starter().start(here, "-c", code, log=here / f"{i}.log", **told) for i in range(3)]
    assert [command.wait() for command in commands] == [0] * 3, told["errors"].read_text()
    outputs = [command.said().strip().partition(" ") for command in commands]
    assert [values for _, _, values in outputs] == ["[[2.0, 2.0, 2.0]]"] * 3
    assert sum(int(compiled) for compiled, _, _ in outputs) == 2  # rows, and scaled_squares, which it calls
    assert not list(cache.rglob("*.lock"))


def test_kernels_can_be_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not switch.off()
    assert switch.identity() == f"numba {numba.__version__}"
    monkeypatch.setenv(switch.SWITCH, "off")
    assert switch.off()
    assert switch.identity() == "off"
    monkeypatch.setenv(switch.SWITCH, "no")
    with pytest.raises(ValueError, match="FMTORCH_KERNELS=no; it must be on or off"):
        switch.off()


def test_the_storage_command_lists_and_clears_them(module: types.ModuleType, cache: Path, tmp_path: Path) -> None:
    result(module)

    def listing(*options: str) -> str:
        environment = {"FMTORCH_CACHE": str(cache.parent)}
        done = run_command("fmtorch.runs", *options, cwd=tmp_path, environment=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    version = next(cache.iterdir()).name
    assert version in listing()
    assert version not in listing("--clear-kernels")
    assert not cache.exists()
