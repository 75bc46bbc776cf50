"""Files and functions that fit in the head, in rooms that can be counted."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "fmtorch"
MAX_FILE, MAX_FUNCTION, MAX_ROOMS = 250, 60, 15  # lines, lines without the docstring, folders


def test_fifteen_rooms_at_most() -> None:
    assert len(list(PACKAGE.glob("*/__init__.py"))) <= MAX_ROOMS


def test_files_fit_in_the_head() -> None:
    lengths = {str(path.relative_to(PACKAGE)): path.read_bytes().count(b"\n") for path in PACKAGE.rglob("*.py")}
    assert {name: length for name, length in lengths.items() if length > MAX_FILE} == {}


def test_functions_fit_on_a_screen() -> None:
    lengths = {
        f"{path.relative_to(PACKAGE)}: {node.name}": _length(node)
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_bytes()))
        if isinstance(node, ast.FunctionDef)
    }
    assert {name: length for name, length in lengths.items() if length > MAX_FUNCTION} == {}


def _length(function: ast.FunctionDef) -> int:
    """Lines of a function, its signature included and its docstring not."""
    docstring = ast.get_docstring(function, clean=False)
    lines = (function.end_lineno or 0) - function.lineno + 1
    return lines - (len(docstring.splitlines()) if docstring else 0)
