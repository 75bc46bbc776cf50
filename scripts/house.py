"""The size and shape of the project: `python scripts/house.py [--check]`; with --check, 1 where a limit is broken."""

import ast
import functools
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LIMITS: dict[str, float] = {
    "files": 300, "lines": 42_000, "import lines, %": 6, "longest file": 500, "longest function": 60,
    "modules loaded": 100, "foreign packages loaded": 0, "files of the road": 6, "imports by string": 0,
    "lines of tests": 31_000, "inner modules that tests import": 80, "files of scripts": 35, "lines of scripts": 5_500,
    "words of pages": 38_000, "words of the longest page": 1_500,
}  # fmt: skip
FOREIGN = ("hydra", "cv2", "pyarrow", "kornia", "scipy.sparse")  # what a first estimate has no use for
ESTIMATE = """
import torch, fmtorch
x = torch.rand(2, 30, 2) * 500
fmtorch.find_fundamental(x[0], x[1], size0="unknown", size1="unknown")
"""
WATCH = """
import os, sys, threading, traceback
def watch(frame, event, argument):
    if event == "call" and "/geometry/seven_point" in frame.f_code.co_filename and frame.f_code.co_flags & 1:
        print(*(passed.filename for passed in traceback.extract_stack(frame)), flush=True)
        os._exit(0)
threading.setprofile(watch); sys.setprofile(watch)
"""  # co_flags & 1: of a function, as opposed to the body of a module or class


def lines(paths: Iterable[Path]) -> list[int]:
    return [path.read_bytes().count(b"\n") for path in paths]


def nodes(paths: Iterable[Path], *kinds: type[ast.AST]) -> list[Any]:
    return [node for path in paths for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, kinds)]


def span(node: Any) -> int:
    """Lines of a statement; of a function without its docstring."""
    docstring = ast.get_docstring(node, clean=False) if isinstance(node, ast.FunctionDef) else None
    return int(node.end_lineno - node.lineno + 1 - len((docstring or "").splitlines()))


def imports_by_string(paths: Iterable[Path]) -> int:
    """Strings that name a module of the package, as code that imports it by name has."""
    values = [node.value for node in nodes(paths, ast.Constant) if isinstance(node.value, str)]
    places = [ROOT.joinpath(*value.split(".")) for value in values if re.fullmatch(r"fmtorch(\.\w+)+", value)]
    return sum(place.with_suffix(".py").exists() or (place / "__init__.py").exists() for place in places)


def inner_modules(paths: Iterable[Path]) -> set[str]:
    """The modules within rooms of the package, as fmtorch.geometry.epipolar, that files import."""
    names: set[str] = set()
    for node in nodes(paths, ast.Import, ast.ImportFrom):
        module = getattr(node, "module", None)
        members = [alias.name for alias in node.names if alias.name not in exported(module or "")]
        names |= {module, *(f"{module}.{member}" for member in members)} if module else set(members)
    files = {path.with_suffix("") for path in (ROOT / "fmtorch").rglob("*.py")}
    inner = {name: ROOT.joinpath(*name.split(".")) for name in names if name.count(".") > 1}
    return {name for name, path in inner.items() if {path, path / "__init__"} & files}


@functools.cache
def exported(package: str) -> tuple[str, ...]:
    """The names that a room lists as its own, some of which a module within it has, too: a function `seven_point`."""
    file = ROOT.joinpath(*package.split("."), "__init__.py")
    assignments = nodes([file], ast.Assign) if file.exists() else []
    return next((ast.literal_eval(node.value) for node in assignments if node.targets[0].id == "__all__"), ())


def words() -> dict[str, int]:
    pages = [*ROOT.glob("docs/**/*.md"), *(ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING"))]
    pages = [page for page in pages if page.parent.name != "reference"]
    return {str(page.relative_to(ROOT)): len(page.read_text(encoding="utf-8").split()) for page in pages}


def printed(code: str, **environment: str) -> list[str]:
    command, variables = [sys.executable, "-c", code], {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run(command, env=variables, stdout=subprocess.PIPE, text=True, check=True).stdout.split()


def loaded() -> list[str]:
    """The modules that a process has imported when it has estimated one fundamental matrix."""
    return printed(f"{ESTIMATE}import sys; print(*sys.modules)")


def road() -> list[str]:
    """The files of the package from `find_fundamental` to the seven-point solver, with kernels interpreted."""
    passed = printed(WATCH + ESTIMATE, FMTORCH_KERNELS="off")
    files = dict.fromkeys(name.removeprefix(f"{ROOT}/") for name in passed if name.startswith(f"{ROOT}/fmtorch/"))
    return [name for name in files if name != "fmtorch/jit/kernel.py"]  # passed by interpreted kernels alone


def figures() -> dict[str, float]:
    """The figures of the project that reading its files gives."""
    package, tests, scripts = (sorted((ROOT / name).rglob("*.py")) for name in ("fmtorch", "tests", "scripts"))
    sizes, pages = lines(package), words()
    return {
        "files": len(package), "lines": sum(sizes),
        "import lines, %": 100 * sum(map(span, nodes(package, ast.Import, ast.ImportFrom))) / sum(sizes),
        "median file": statistics.median(sizes), "90 % of files below": statistics.quantiles(sizes, n=10)[-1],
        "longest file": max(sizes), "longest function": max(map(span, nodes(package, ast.FunctionDef))),
        "imports by string": imports_by_string(path for path in package if path != ROOT / "fmtorch" / "__init__.py"),
        "lines of tests": sum(lines(tests)), "inner modules that tests import": len(inner_modules(tests)),
        "files of scripts": len(scripts), "lines of scripts": sum(lines(scripts)),
        "words of pages": sum(pages.values()), "words of the longest page": max(pages.values()),
    }  # fmt: skip


def main() -> None:
    modules, files, now = loaded(), road(), figures()
    foreign = [name for name in FOREIGN if name in modules]
    now |= {"foreign packages loaded": len(foreign), "files of the road": len(files)}
    now["modules loaded"] = sum(name.partition(".")[0] == "fmtorch" for name in modules)
    for name, value in now.items():
        limit = f"at most {LIMITS[name]:,}" + " BROKEN" * (value > LIMITS[name]) if name in LIMITS else ""
        print(f"{name:32}{value:10,.{int('%' in name)}f}  {limit}")
    print(f"foreign packages: {', '.join(foreign) or 'none'}\nthe road:\n  " + "\n  ".join(files))
    sys.exit("--check" in sys.argv[1:] and any(now[name] > limit for name, limit in LIMITS.items()))


if __name__ == "__main__":
    main()
