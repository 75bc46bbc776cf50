"""The code that makes a result: commits, changed sources, the modules of a user's own parts and what they import."""

import importlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fmtorch import __version__
from fmtorch.runs import fingerprint


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A checkout of another program, taken for this one."""
    folder = tmp_path / "checkout" / "fmtorch"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("one")
    (folder.parent / "pyproject.toml").write_text("")
    monkeypatch.setattr(fingerprint, "PACKAGE", folder)
    fingerprint.fmtorch_version.cache_clear()
    yield folder
    fingerprint.fmtorch_version.cache_clear()


def version() -> str:
    fingerprint.fmtorch_version.cache_clear()
    return fingerprint.fmtorch_version()


def git(folder: Path, *arguments: str) -> str:
    who = ["-c", "user.name=A", "-c", "user.email=a@b"]
    command = ["git", "-C", str(folder), *who, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_checkout_is_its_commit_and_what_was_changed_since(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkout = package.parent
    git(checkout, "init", "-q")
    assert version().startswith(f"{__version__}+sources.")  # nothing is committed yet
    git(checkout, "add", ".")
    git(checkout, "commit", "-qm", "first")
    commit = git(checkout, "rev-parse", "HEAD")
    clean = f"{__version__}+g{commit[: fingerprint.DIGITS]}"
    assert version() == clean
    (checkout / "notes.md").write_text("decides nothing")
    monkeypatch.setenv("GIT_DIR", str(checkout / "elsewhere"))  # as within a hook of another repository
    assert version() == clean
    monkeypatch.delenv("GIT_DIR")
    (package / "a.py").write_text("two")
    dirty = version()
    assert dirty.startswith(f"{clean}.dirty.")
    (package / "a.py").write_text("three")
    assert dirty != version() != clean
    (package / "a.py").write_text("one")
    assert version() == clean
    (package / "b.py").write_text("new")
    assert version().startswith(f"{clean}.dirty.")


def test_without_git_the_sources_tell(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (package.parent / ".git").mkdir()  # which git refuses, were it there
    monkeypatch.setenv("PATH", "")
    first = version()
    assert first.startswith(f"{__version__}+sources.")
    (package / "a.py").write_text("two")
    assert version() != first
    (package.parent / "pyproject.toml").unlink()  # installed: the version says it all
    assert version() == __version__


OWN = {
    "lone.py": "import helper\nfrom folder import inner\nimport json, numpy",
    "helper.py": "from folder.inner import x",
    "folder/inner.py": "x = 1",
    "folder/unused.py": "",
    "other.py": "",
    "parts/__init__.py": "",
    "parts/common.py": "import lone",
    "parts/deep/stage.py": "from ..common import lone\nfrom . import near\nimport fmtorch.core.types",
    "parts/deep/near.py": "",
    "parts/deep/below/far.py": "",
    "parts/broken.py": "",
}
FOLLOWED = {
    "lone": {"lone.py", "helper.py", "folder/inner.py"},
    "parts.deep.stage": {
        *("parts/deep/stage.py", "parts/deep/near.py", "parts/deep/below/far.py", "parts/common.py"),
        *("lone.py", "helper.py", "folder/inner.py"),
    },
}


@pytest.mark.parametrize("module", FOLLOWED)
def test_a_module_is_all_that_it_imports_of_its_own(module, tmp_path, monkeypatch):
    for name, text in OWN.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    names = [name.removesuffix(".py").replace("/", ".") for name in OWN]
    for name in ("parts", "parts.deep", "folder", *names):
        monkeypatch.delitem(sys.modules, name, raising=False)
    importlib.import_module(module)

    def of() -> str:
        fingerprint.code_digest.cache_clear()
        return fingerprint.code_digest(module)

    before = of()
    assert of() == before
    changing = set()
    for name, text in OWN.items():
        (tmp_path / name).write_text(f"{text}\n# edited")
        changing |= {name} if of() != before else set()
        (tmp_path / name).write_text(text)
    assert changing == FOLLOWED[module]
    (tmp_path / "helper.py").write_text("not python")  # what does not compile is told by its text, and follows nothing
    assert of() != before
    for name in names:
        sys.modules.pop(name, None)


def test_a_module_without_a_file_is_refused() -> None:
    with pytest.raises(TypeError, match="sys is in no file"):
        fingerprint.code_digest("sys")
