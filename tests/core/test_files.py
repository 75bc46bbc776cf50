"""Files that are whole or absent, and errors that name them."""

import errno
from pathlib import Path

import pytest

from fmtorch.core import files
from fmtorch.core.files import replacing
from fmtorch.core.terminal import error_line


def message(error: BaseException) -> str:
    """What a command says of an error, without the place in this file, which counts as a user's own code."""
    return error_line(error).partition(f" ({Path(__file__).name}:")[0]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), OSError(errno.EIO, "I/O error")])
def test_a_failed_write_names_the_file_and_leaves_what_was_there(error: OSError, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text("before")

    def write() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(OSError, match=error.strerror) as caught:
        write()
    assert caught.value.errno == error.errno
    assert message(caught.value) == f"{path}: {error.strerror}"
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_named_by_the_file() -> None:
    path = Path("/nowhere/at/all.txt")
    with pytest.raises(FileNotFoundError) as caught, replacing(path) as temporary:
        temporary.write_text("")
    assert message(caught.value) == f"{path}: No such file or directory"


def test_another_files_error_stays_its_own(tmp_path: Path) -> None:
    other = tmp_path / "image.png"
    with pytest.raises(FileNotFoundError) as caught, replacing(tmp_path / "out.json"):
        other.read_bytes()
    assert message(caught.value) == f"{other}: No such file or directory"


def test_a_device_that_is_full(tmp_path: Path) -> None:
    """The kernel's own error, which names no file."""
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with (
        pytest.raises(OSError, match="No space left") as caught,
        replacing(tmp_path / "out.json"),
        full.open("wb") as file,
    ):
        file.write(b"x" * 100_000)
    assert message(caught.value) == f"{tmp_path / 'out.json'}: No space left on device"


def _installation(root: Path, monkeypatch: pytest.MonkeyPatch, *folders: str) -> Path:
    package = root / "site-packages" / "fmtorch"
    package.mkdir(parents=True)
    for folder in folders:
        (root / "site-packages" / folder).mkdir(parents=True)
    monkeypatch.setattr(files, "PACKAGE", package)
    return package


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
