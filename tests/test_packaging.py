"""What is built and installed: the wheel's contents, where it finds its folders, the pinned versions."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import fmtorch

CHECKOUT = Path(__file__).resolve().parents[1]
PYTHONS = [f"python3.{minor}" for minor in range(11, 15)]
RELEASED = ("pyproject.toml", "fmtorch/core/version.py", "CITATION.cff", "CHANGELOG.md", "scripts/release")


def _project() -> dict[str, object]:
    with open(CHECKOUT / "pyproject.toml", "rb") as file:
        project: dict[str, object] = tomllib.load(file)["project"]
    return project


def _build(source: Path, target: str, folder: Path) -> Path:
    """Build offline with the backend itself."""
    pytest.importorskip("hatchling")
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build(CHECKOUT, "wheel", tmp_path_factory.mktemp("wheel"))


def _names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def _tree(folder: Path, prefix: str) -> set[str]:
    """The files below a folder of the checkout, as they are named in the wheel."""
    files = (file.relative_to(folder) for file in folder.rglob("*") if file.is_file() and file.suffix != ".tmp")
    return {f"{prefix}/{file.as_posix()}" for file in files if "__pycache__" not in file.parts}


def test_wheel_carries_the_package_with_its_folders(wheel: Path) -> None:
    names = _names(wheel)
    assert {name.split("/")[0] for name in names} == {"fmtorch"}  # no conf, models or tests at top level
    for folder, prefix in (("conf", "fmtorch/conf"), ("models", "fmtorch/models"), ("fmtorch", "fmtorch")):
        files = _tree(CHECKOUT / folder, prefix)
        assert files
        assert files <= names


def test_wheel_carries_the_licence_and_the_version(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        metadata = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        text = archive.read(metadata).decode()
        assert any(name.endswith("/LICENSE") for name in archive.namelist())
    assert "License-Expression: Apache-2.0" in text
    assert f"Version: {fmtorch.__version__}" in text
    assert fmtorch.__version__ == _project()["version"]


def test_source_distribution_builds_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(_build(CHECKOUT, "sdist", tmp_path / "sdist")) as file:
        file.extractall(tmp_path / "source", **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    (source,) = (tmp_path / "source").iterdir()
    assert (source / "constraints.txt").is_file()
    assert (source / "tests" / "conftest.py").is_file()
    assert _names(_build(source, "wheel", tmp_path / "wheel")) == _names(wheel)


def test_unpacked_wheel_finds_its_folders_from_any_directory(wheel: Path, tmp_path: Path) -> None:
    root = tmp_path / "site-packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(root)
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "conf").mkdir(parents=True)  # a user's own folder of that name must not be taken
    code = "import fmtorch.core.files as files; print(files.__file__, files.conf_dir(), files.models_dir())"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=elsewhere, env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    package = (root / "fmtorch").resolve()
    expected = [package / "core" / "files.py", package / "conf", package / "models"]
    assert [Path(line) for line in done.stdout.split()] == expected


def test_constraints_pin_every_declared_dependency_within_its_range_exactly_and_portably() -> None:
    lines = [line for line in (CHECKOUT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    for line in lines:  # no local versions (2.13.0+cpu), which only some package indexes have
        assert re.fullmatch(r"[a-z0-9-]+==[0-9][0-9a-z.]*", line), line
    pins = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    project = _project()
    extras = project["optional-dependencies"]
    declared = [*project["dependencies"], *extras["test"], *extras["dev"]]  # type: ignore[index,misc]
    for text in declared:
        requirement = Requirement(text)
        if requirement.name != "fmtorch":
            assert pins[canonicalize_name(requirement.name)] in requirement.specifier, text


def _interpreter(name: str) -> str | None:
    """An interpreter of this version on this machine that has venv."""
    folders = [*map(str, Path.home().glob(".pyenv/versions/*/bin")), os.environ.get("PATH", "")]
    found = shutil.which(name, path=os.pathsep.join(folders))
    works = found and not subprocess.run([found, "-c", "import venv"], capture_output=True, check=False).returncode
    return found if works else None


@pytest.mark.parametrize("python", PYTHONS)
def test_the_wheel_is_installed_on_every_python_that_is_here(wheel: Path, python: str, tmp_path: Path) -> None:
    """Without dependencies, which some versions have no wheels of: every file compiles, the command answers."""
    interpreter = _interpreter(python)
    if interpreter is None:
        pytest.skip(f"there is no {python} with venv")
    subprocess.run([interpreter, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    pip = [sys.executable, "-m", "pip", "--python", tmp_path / "venv/bin/python", "install", "-q", "--no-compile"]
    subprocess.run([*pip, "--no-deps", "--no-index", "--disable-pip-version-check", wheel], check=True)
    (package,) = tmp_path.glob("venv/lib/*/site-packages/fmtorch")
    subprocess.run([tmp_path / "venv/bin/python", "-m", "compileall", "-q", package], check=True)
    for words in (["--version"], ["--help"], ["verify", "--help"]):
        command = [tmp_path / "venv/bin/fmtorch", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), words


@pytest.fixture
def release(tmp_path: Path) -> Path:
    """A repository of what the release script looks at, the changelog dated."""
    for name in RELEASED:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        text = (CHECKOUT / name).read_text().replace(" (unreleased)", " (2030-01-01)")
        (tmp_path / name).write_text(text)
    (tmp_path / "scripts/release").chmod(0o755)
    for words in (["init", "-q"], ["add", "-A"], ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "x"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


def _refused(folder: Path, *words: str) -> str:
    done = subprocess.run(["scripts/release", *words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    return done.stderr


def test_a_release_is_refused_before_anything_is_built(release: Path) -> None:
    assert "pyproject.toml does not state 9.9.9" in _refused(release, "9.9.9")
    version = str(_project()["version"])
    subprocess.run(["git", "tag", f"v{version}"], cwd=release, check=True)
    assert "is tagged already" in _refused(release, version)
    (release / "CHANGELOG.md").write_text("")
    assert "not committed" in _refused(release, version)
    assert not (release / "dist").exists()


def test_the_image_holds_what_the_wheel_is_built_of() -> None:
    lines = (CHECKOUT / "Dockerfile").read_text().splitlines()
    copied = {word for line in lines if line.startswith("COPY ") for word in line.split()[1:-1]}
    allowed = {line[1:] for line in (CHECKOUT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert copied == allowed
    assert all((CHECKOUT / name).exists() for name in copied)
    assert any("fmtorch warm-up" in line for line in lines)
