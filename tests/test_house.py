"""Files and functions that fit in the head, in rooms that can be counted."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "fmtorch"
MAX_FILE, MAX_FUNCTION, MAX_ROOMS = 500, 60, 20  # lines, lines without the docstring, folders
MAX_ARGUMENTS = 6  # of a kernel


def test_twenty_rooms_at_most() -> None:
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


def test_kernels_take_few_arguments_whose_types_are_annotated() -> None:
    kernels, wrong = 0, []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.FunctionDef) and _is_kernel(node):
                arguments = node.args
                right = len(arguments.args) <= MAX_ARGUMENTS and all(each.annotation for each in arguments.args)
                other = [*arguments.posonlyargs, *arguments.kwonlyargs, *arguments.defaults]
                kernels += 1
                if not right or other or arguments.vararg or arguments.kwarg:
                    wrong.append(f"{path.relative_to(PACKAGE)}: {node.name}")
    assert kernels > 50
    assert wrong == []


def _is_kernel(function: ast.FunctionDef) -> bool:
    """Whether it is decorated by ``@kernel`` or ``@kernel(...)``."""
    decorators = [each.func if isinstance(each, ast.Call) else each for each in function.decorator_list]
    return any(isinstance(each, ast.Name) and each.id == "kernel" for each in decorators)


def _length(function: ast.FunctionDef) -> int:
    """Lines of a function, its signature included and its docstring not."""
    docstring = ast.get_docstring(function, clean=False)
    lines = (function.end_lineno or 0) - function.lineno + 1
    return lines - (len(docstring.splitlines()) if docstring else 0)
