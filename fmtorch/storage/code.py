"""The code that makes a result: the version of fmtorch, in a checkout its commit, and the sources of a user's parts."""

from __future__ import annotations

import ast
import functools
import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from fmtorch.core.version import __version__

PACKAGE = Path(__file__).resolve().parents[1]
DIGITS = 12  # of a commit or digest that a version shows
GIT_SECONDS = 10  # after which git is taken for absent
INSTALLED = ("site-packages", "dist-packages")  # folders of other people's code: its imports are not followed


@functools.cache
def fmtorch_version() -> str:
    """The version of the code that runs; in a checkout with its commit, and what sources were changed since.

    ``0.1.0`` installed; ``0.1.0+g5c0279c1d2e3`` in a checkout; ``0.1.0+g5c0279c1d2e3.dirty.0f1e2d3c4b5a``, with the
    digest of the sources, where they are not those of the commit; ``0.1.0+sources.0f1e2d3c4b5a`` where there is no git
    that tells.
    """
    checkout = PACKAGE.parent
    if not (checkout / "pyproject.toml").is_file():
        return __version__
    sources = _digest_of(sorted(PACKAGE.rglob("*.py")))[:DIGITS]
    commit = _git(checkout, "rev-parse", "HEAD") if (checkout / ".git").exists() else None
    changes = _git(checkout, "status", "--porcelain", "--untracked-files=all", "--", PACKAGE.name) if commit else None
    if not commit or changes is None:
        return f"{__version__}+sources.{sources}"
    return f"{__version__}+g{commit[:DIGITS]}" + (f".dirty.{sources}" if changes else "")


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints; None where it is not installed, refuses, or knows no commit."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=GIT_SECONDS, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


@functools.cache
def code_digest(module: str) -> str:
    """The digest of an imported module's source and of what it imports from its own code, at any depth.

    Its own code is the package for a module of fmtorch; for anybody else's the folder that its imports start from, and
    the files beside and below it whether it imports them or not; of installed packages only these.
    Raises TypeError for a module without a file.
    """
    name = getattr(sys.modules[module], "__file__", None)
    if name is None:
        raise TypeError(f"the code of {module} is in no file, so its changes cannot be noticed")
    file = Path(name).absolute()
    start = file.parents[module.count(".") + (file.stem == "__init__")]
    own = module.partition(".")[0] == PACKAGE.name
    if start.name in INSTALLED and not own:
        return _digest_of(sorted(file.parent.rglob("*.py") if "." in module else [file]))
    beside = set() if own or "." not in module else set(file.parent.rglob("*.py"))
    return _digest_of(sorted(beside | _imported(file, start, own)))


def _imported(file: Path, start: Path, own: bool) -> set[Path]:
    """The file, and those below `start` that it imports, and these in turn; of code that does not compile no more.

    own: whether it is of fmtorch, whose imports are followed then, and not those of anybody else.
    """
    files: set[Path] = set()
    todo = [file]
    while todo:
        file = todo.pop()
        if file in files:
            continue
        files.add(file)
        todo += [path for statement in _imports(file.read_bytes()) for path in _files_of(statement, file, start, own)]
    return files


class _Import(NamedTuple):
    """An import statement: the dots it begins with (None: no `from`), the module after `from`, and the names."""

    level: int | None
    module: str
    names: tuple[str, ...]


@functools.cache  # parts of a pipeline share most of what they import
def _imports(source: bytes) -> tuple[_Import, ...]:
    """The import statements of a file, wherever in it; none where it does not compile."""
    try:
        nodes = _statements(ast.parse(source))
    except (SyntaxError, ValueError):
        return ()
    return tuple(
        _Import(
            node.level if isinstance(node, ast.ImportFrom) else None,
            (isinstance(node, ast.ImportFrom) and node.module) or "",
            tuple(alias.name for alias in node.names),
        )
        for node in nodes
        if isinstance(node, ast.Import | ast.ImportFrom)
    )


def _statements(tree: ast.Module) -> list[ast.AST]:
    """All statements of a file, wherever in it; much faster than a walk through its expressions, too."""
    statements: list[ast.AST] = []
    todo: list[ast.AST] = [tree]
    while todo:
        node = todo.pop()
        statements.append(node)
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            todo += getattr(node, block, ())
    return statements


def _files_of(statement: _Import, file: Path, start: Path, own: bool) -> Iterator[Path]:
    """The files below `start` that an import statement of `file` names.

    Of anybody's own code with the packages on the way; of fmtorch's, whose packages import all that is in them,
    without.
    """
    level, module, imported = statement
    if level is None:
        names = [(start, name) for name in imported]
    else:
        folder = file.parents[level - 1] if level else start
        names = [(folder, f"{module}.{name}".strip(".")) for name in imported]
        names += [(folder, module)] if module and own else []
    for folder, name in names:
        if folder == start and (name.partition(".")[0] == PACKAGE.name) != own:
            continue  # its version tells
        path = folder
        words = name.split(".")
        for depth, word in enumerate(words, start=1):
            path = path / word
            if not own or depth == len(words):
                yield from (p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file())


def _digest_of(files: list[Path]) -> str:
    return digest(b"".join(digest(path.read_bytes()).encode() for path in files))


def digest(data: Any) -> str:
    """The hex digest (blake2b, 128 bits) of bytes, or of an array's."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()
