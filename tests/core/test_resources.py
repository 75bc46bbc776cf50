from __future__ import annotations

from pathlib import Path

import pytest

import fmtorch
from fmtorch.core import files

CHECKOUT = Path(fmtorch.__file__).resolve().parents[1]


def _installation(root: Path, monkeypatch: pytest.MonkeyPatch, *folders: str) -> Path:
    package = root / "site-packages" / "fmtorch"
    package.mkdir(parents=True)
    for folder in folders:
        (root / "site-packages" / folder).mkdir(parents=True)
    monkeypatch.setattr(files, "_PACKAGE", package)
    return package


def test_in_this_checkout() -> None:
    assert files.models_dir() == CHECKOUT / "models"
    assert files.conf_dir() == CHECKOUT / "conf"


def test_folders_do_not_depend_on_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = files.models_dir()
    (tmp_path / "models").mkdir()
    monkeypatch.chdir(tmp_path)
    assert files.models_dir() == before
    assert before.is_absolute()


def test_an_installed_wheel_uses_its_own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = _installation(tmp_path, monkeypatch, "fmtorch/conf", "fmtorch/models", "conf", "models")
    assert files.conf_dir() == package / "conf"
    assert files.models_dir() == package / "models"


def test_an_incomplete_installation_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = _installation(tmp_path, monkeypatch)
    with pytest.raises(FileNotFoundError, match=f"'conf' in {package}"):
        files.conf_dir()


def test_cache_dir(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/someone")
    monkeypatch.setenv("XDG_CACHE_HOME", "/scratch/cache")
    monkeypatch.setenv("FMTORCH_CACHE", "/data/fmtorch")
    assert files.cache_dir() == Path("/data/fmtorch")
    monkeypatch.setenv("FMTORCH_CACHE", "~/here")
    assert files.cache_dir() == Path("/home/someone/here")
    monkeypatch.setenv("FMTORCH_CACHE", "")
    assert files.cache_dir() == Path("/scratch/cache/fmtorch")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert files.cache_dir() == Path("/home/someone/.cache/fmtorch")
