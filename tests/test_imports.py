"""Which room may import which, read from the syntax tree of every file, wherever in it an import stands; the road of a
pair: few files from `find_fundamental` to the solver, and little else in the process."""

import ast
import functools
import graphlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from scripts import house

PACKAGE = Path(__file__).resolve().parents[1] / "fmtorch"
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
GROUND = "core jobs jit geometry"
MAY_IMPORT = {
    "core": "",
    "jobs": "core",
    "jit": "core jobs",
    "geometry": "core jobs jit",
    **dict.fromkeys(("metrics", "matching", "features", "pruning", "estimators"), GROUND),
    "data": "core jobs presets",
    "scenes": "core jobs jit data",
    "io": GROUND + " data",
    "runs": "core jobs jit data",
    "presets": "core jobs",
    "two_view": GROUND + " estimators pruning presets",
    "pipeline": GROUND + " data io runs presets two_view",
    "verification": GROUND + " data io runs presets two_view pipeline",
    "evaluation": GROUND + " metrics data scenes io runs presets two_view pipeline",
    "training": " ".join(room for room in ROOMS if room != "commands"),
    "commands": " ".join(ROOMS),
}
TORCH = {"torch", "torchvision", "torchmetrics", "kornia", "lightning"}  # the last four import the first
NUMBA = {"numba", "llvmlite"}
TENSORS_OF_ESTIMATORS = ("batch.py", "gradients.py", "irls.py", "external/")
MAX_FILE, MAX_FUNCTION = 500, 60  # lines, lines without the docstring
MAX_ARGUMENTS = 6  # of a kernel
PAGE = Path(house.ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
MAX_FILES, MAX_MODULES = 6, 92
ELSEWHERE = (
    "PIL", "cv2", "hydra", "kornia", "matplotlib", "omegaconf", "onnxruntime", "pyarrow", "scipy.sparse", "skimage"
)  # fmt: skip


PATHS = [path.relative_to(PACKAGE.parent) for path in sorted(PACKAGE.rglob("*.py"))]
FILES = {".".join(path.with_suffix("").parts).removesuffix(".__init__"): PACKAGE.parent / path for path in PATHS}
"""By modules' names: fmtorch.core.types, fmtorch.data."""


@functools.cache
def nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_bytes())))


@functools.cache
def imported(module: str) -> frozenset[str]:
    """What a file imports, modules of fmtorch by their full names; not the packages on the way to them."""
    names: set[str] = set()
    for node in nodes(FILES[module]):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            members = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= members & FILES.keys() or {str(node.module)}
            names |= {str(node.module)} if members - FILES.keys() else set()
    return frozenset(names)


def room(module: str) -> str:
    """The room of a module of fmtorch; empty for the package itself and the commands' own modules at its top."""
    name = f"{module}.".split(".")[1]
    return name if name in ROOMS else ""


def within(module: str) -> set[str]:
    return {name for name in imported(module) if name in FILES}


def libraries(module: str) -> set[str]:
    return {name.partition(".")[0] for name in imported(module)}


def test_every_room_has_its_rule() -> None:
    assert set(MAY_IMPORT) == set(ROOMS)


def test_rooms_import_what_they_may() -> None:
    pairs = [(module, name) for module in FILES if room(module) for name in within(module)]
    may = {room: [room, *names.split()] for room, names in MAY_IMPORT.items()}
    assert [(module, name) for module, name in pairs if room(name) not in may[room(module)]] == []


def test_numba_is_imported_by_jit_alone() -> None:
    assert [m for m in FILES if libraries(m) & NUMBA and room(m) != "jit"] == []


def test_no_circle_between_files() -> None:
    try:
        list(graphlib.TopologicalSorter({module: within(module) - {module} for module in FILES}).static_order())
    except graphlib.CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_estimators_take_tensors_at_their_edges_alone() -> None:
    root = PACKAGE / "estimators"
    files = {m: path.relative_to(root).as_posix() for m, path in FILES.items() if room(m) == "estimators"}
    tensors = [path for m, path in files.items() if libraries(m) & TORCH]
    assert [path for path in tensors if not path.startswith(TENSORS_OF_ESTIMATORS)] == []


def last_name(node: ast.expr) -> str:
    """``inner`` of ``@inner``, ``@numba.inner`` and ``@inner(inline=True)``."""
    if isinstance(node, ast.Call):
        node = node.func
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    for module, path in FILES.items():
        yield from ((f"{module}.{n.name}", n) for n in nodes(path) if isinstance(n, ast.FunctionDef))


def test_files_fit_in_the_head_and_functions_on_a_screen() -> None:
    assert [module for module, path in FILES.items() if path.read_bytes().count(b"\n") > MAX_FILE] == []
    assert [name for name, function in functions() if house.span(function) > MAX_FUNCTION] == []


def test_kernels_take_few_arguments_whose_types_are_annotated() -> None:
    kernels, wrong = 0, []
    for name, function in functions():
        if any(last_name(decorator) == "kernel" for decorator in function.decorator_list):
            arguments = function.args
            right = len(arguments.args) <= MAX_ARGUMENTS and all(each.annotation for each in arguments.args)
            other = [*arguments.posonlyargs, *arguments.kwonlyargs, *arguments.defaults]
            kernels += 1
            if not right or other or arguments.vararg or arguments.kwarg:
                wrong.append(name)
    assert kernels > 50
    assert wrong == []


def test_the_road_of_a_pair_is_the_files_that_the_page_names() -> None:
    paragraph = PAGE[PAGE.index("**The road of a pair**") :].split("\n\n")[0]
    road = [file.removeprefix("fmtorch/") for file in house.road()]
    assert road == re.findall(r"`([\w/]+\.py)`", paragraph)
    assert len(road) <= MAX_FILES


def test_a_process_loads_what_it_needs() -> None:
    """Compilers, torch's and numba, no earlier than the first estimate."""
    names = "print(*sys.modules, '|')\n"
    words = house.printed(f"import sys, fmtorch; fmtorch.find_fundamental; {names}{house.ESTIMATE}{names}")
    before, modules, _ = (each.split() for each in " ".join(words).split("|"))
    assert not {"torch._dynamo", "numba"} & {*before}
    assert [name for name in ELSEWHERE if name in modules] == []
    assert len([name for name in modules if name.partition(".")[0] == "fmtorch"]) <= MAX_MODULES
