"""Commands within this process, which saves its start."""

import importlib
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import own_cache
from tests.helpers import call_main


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command in a folder; returns what it prints and, after a mistake, what it ends with."""

    def run(name: str, *words: str, cwd: Path) -> str:
        monkeypatch.setenv("FMTORCH_CACHE", str(own_cache(cwd)))
        monkeypatch.setenv("COLUMNS", "200")
        monkeypatch.syspath_prepend(str(cwd))
        end = ""
        try:
            call_main(importlib.import_module(f"fmtorch.commands.{name}").main, monkeypatch, cwd, *words)
        except SystemExit as error:
            end = f"ended: {error.code}"
        printed = capsys.readouterr()
        return printed.out + printed.err + end

    return run
