"""Where the tests find shared data: $FMTORCH_TEST_DATA, by default the folder `shared` beside the checkout."""

import contextlib
import importlib
import os
import pkgutil
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping._import_hook import _JaxtypingLoader

from fmtorch.jit.cache import kernels_dir

torch.set_num_threads(1)

SHARED = Path(os.environ.get("FMTORCH_TEST_DATA", Path(__file__).resolve().parents[2] / "shared"))
KERNELS = kernels_dir()  # before any test sets $FMTORCH_CACHE
if os.environ.pop(
    "PYTHONDONTWRITEBYTECODE", None
):  # with which each of many processes would compile all that it imports
    sys.dont_write_bytecode = False
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(KERNELS.with_name("bytecode"))


LONGEST = (
    "training/test_train_command.py", "commands/", "docs/test_commands.py", "reliability/", "test_packaging.py",
    "features/test_local_feature.py", "training/", "scenes/test_rendered.py", "test_processors.py",
)  # fmt: skip
"""Files and folders with tests of many seconds."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests come first, so that at the end no process waits for another that has just begun one."""
    here = Path(__file__).parent
    items.sort(key=lambda item: not item.path.relative_to(here).as_posix().startswith(LONGEST))


def pytest_collection_finish() -> None:
    """From here on bytecode with checks is kept nowhere: where threads import modules at the same time, it can get the
    name of that without, which other processes then load."""
    _JaxtypingLoader.set_data = lambda *_, **__: None  # type: ignore[method-assign]


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile every kernel before several processes run the whole suite, each of which would compile them again."""
    config = session.config
    starts_others = getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput")
    if starts_others and config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        # elsewhere, since here the import hook of the type checker would take longer than the rest
        code = "from tests.conftest import compile_all; compile_all()"
        subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).resolve().parents[1], check=True)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Bytecode of files in temporary folders is of no use again."""
    if sys.pycache_prefix == str(KERNELS.with_name("bytecode")) and not hasattr(session.config, "workerinput"):
        temporary = Path(tempfile.gettempdir()).resolve()
        shutil.rmtree(Path(sys.pycache_prefix, *temporary.parts[1:]), ignore_errors=True)


def compile_all() -> None:
    """Compile every kernel of the package that this machine has not compiled yet."""
    import fmtorch
    from fmtorch.jit import kernel as switch
    from fmtorch.jit.kernel import Kernel, compile_together

    if switch.off():
        return
    names = [each.name for each in pkgutil.walk_packages(fmtorch.__path__, "fmtorch.") if "__main__" not in each.name]
    modules = [importlib.import_module(name) for name in names]
    kernels = [value for module in modules for value in vars(module).values() if isinstance(value, Kernel)]
    compile_together(list({id(each): each for each in kernels}.values()))


def own_cache(folder: Path) -> Path:
    """`folder`/cache, for $FMTORCH_CACHE: nobody else's, but for the compiled kernels, which all tests share."""
    cache = folder / "cache"
    for path in (cache, KERNELS):
        path.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        (cache / "kernels").symlink_to(KERNELS, target_is_directory=True)
    return cache


def shared_path(relative: str) -> Path:
    """A file or folder of the shared data; skips the test where it is absent (fails if FMTORCH_REQUIRE_DATA=1)."""
    path = SHARED / relative
    if not path.exists():
        reason = f"{path} is absent (set FMTORCH_TEST_DATA to the folder that holds {relative})"
        if os.environ.get("FMTORCH_REQUIRE_DATA") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return path


def oracle(name: str) -> dict[str, np.ndarray]:
    """The arrays of one reference file, e.g. oracle("gms.npz")."""
    with np.load(shared_path(f"oracles/{name}")) as file:
        return {key: file[key] for key in file.files}


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command in a folder, in this process; returns what it prints and, after a mistake, what it ends with."""
    from tests.helpers import call_command  # not before the import hook of the type checker

    def run(*words: str, cwd: Path) -> str:
        monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(cwd)))
        monkeypatch.setenv("COLUMNS", "200")
        end = ""
        try:
            call_command(monkeypatch, cwd, *words)
        except SystemExit as error:
            end = f"ended: {error.code}"
        printed = capsys.readouterr()
        return printed.out + printed.err + end

    return run
