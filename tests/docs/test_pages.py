"""Pages: examples give what they say, links lead somewhere, pages are short and current, quoted names exist."""

import ast
import builtins
import csv
import doctest
import functools
import importlib
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from scripts import draw_reference
from tests.test_imports import GROUND, MAY_IMPORT, nodes

SOURCE = Path(__file__).resolve().parents[2]
DOCS = SOURCE / "docs"
PAGES = [*sorted(SOURCE.glob("*.md")), *sorted(DOCS.rglob("*.md")), *sorted((SOURCE / "models").glob("*.md"))]
LIMITS = {"README.md": 1000, "docs/benchmarks": 1000, "docs/reference": 3000}  # words of a page with its tables
MAX_WORDS = 1500


def relative(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_a_page_is_short_and_on_the_map_and_its_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert len(text.split()) <= LIMITS.get(relative(page), LIMITS.get(relative(page.parent), MAX_WORDS))
    text = re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.DOTALL)
    targets = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    files = [target for target in targets if target and not re.match(r"[a-z]+:", target)]
    assert [target for target in files if not (page.parent / target).exists()] == []
    if page.is_relative_to(DOCS) and page.name != "index.md":
        assert f"({page.relative_to(DOCS)})" in (DOCS / "index.md").read_text(encoding="utf-8")


def test_a_table_is_on_its_page() -> None:
    """docs/tables.md lists every CSV file, every line of which has as many cells as its first."""
    page = (DOCS / "tables.md").read_text(encoding="utf-8")
    files = sorted((DOCS / "tables").iterdir())
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert {path.stem for path in files} == {name for cell in rows for name in re.findall(r"`(\w+)`", cell)}
    for path in files:
        with path.open(encoding="utf-8", newline="") as file:
            lines = list(csv.reader(file))
        assert len(lines) > 1
        assert {len(line) for line in lines} == {len(set(lines[0]))}, path.name


@pytest.mark.parametrize("name", ["presets", "command_line"])
def test_a_generated_page_is_current(name: str) -> None:
    page = {"presets": draw_reference.presets_page, "command_line": draw_reference.commands_page}[name]()
    written = (DOCS / "reference" / f"{name}.md").read_text(encoding="utf-8")
    assert written == page, "run python scripts/draw_reference.py"


@pytest.mark.parametrize("page", ["concepts/conventions.md", "concepts/metrics.md", "concepts/three_laws.md"])
def test_the_examples_of_a_page_run(page: str) -> None:
    failed, attempted = doctest.testfile(str(DOCS / page), module_relative=False)
    assert attempted > 0
    assert failed == 0


EXAMPLES = [path for path in sorted((SOURCE / "fmtorch").rglob("*.py")) if ">>> " in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", EXAMPLES, ids=relative)
def test_the_examples_of_docstrings_run(path: Path) -> None:
    failed, attempted = doctest.testmod(importlib.import_module(relative(path.with_suffix("")).replace("/", ".")))
    assert attempted > 0
    assert failed == 0


CODE = [*(SOURCE / "fmtorch").rglob("*.py"), *(SOURCE / "scripts").rglob("*.py")]
LIBRARIES = {
    "concurrent", "cv2", "json", "kornia", "mpi4py", "np", "numpy", "onnxruntime", "poselib", "pycolmap", "torch",
    "vismatch", "PIL",
}  # fmt: skip
VARIABLES = {"F", "c", "config", "e", "estimate", "lens", "pose", "result", "x"}  # of the examples around them
FOREIGN = {"CompileResult", "DMatch", "Dataset", "KeyPoint", "Path", "Progress", "TwoViewGeometry", "UsacParams"}
"""Classes of other libraries."""
SETS = {"Fgt", "Strecha_train", "TanksLike"}
DOTTED = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?:\(.*)?")
SUFFIXES = "bin|csv|db|h5|html|json|md|npz|onnx|out|partial|parts|png|py|sh|shards|svg|txt|verification"
FILE = re.compile(rf"[\w.]+\.({SUFFIXES})")


def docstrings(path: Path) -> Iterator[str]:
    """Of a module, its classes and functions, and the strings that follow constants."""
    for node in nodes(path):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value


@functools.cache
def quoted() -> dict[str, set[str]]:
    """What stands between backquotes, with the files in which it does."""
    found = defaultdict(set)
    texts = [(path, text) for path in CODE for text in docstrings(path)]
    texts += [(page, re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)) for page in PAGES]
    for path, text in texts:
        for name in re.findall(r"`([^`\n]+)`", text):
            found[name].add(path.relative_to(SOURCE).as_posix())
    return found


def dead(pattern: str, known: set[str]) -> dict[str, list[str]]:
    """The names of a form that are not known, with the files that have them."""
    names = {name: sorted(files) for name, files in quoted().items() if re.fullmatch(pattern, name)}
    assert len(names) > 20
    return {name: files for name, files in names.items() if name not in known}


def bound(nodes: Iterable[ast.AST], strings: bool = False) -> set[str]:
    """The names that code defines, assigns or imports; with strings also those that it exports at first use."""
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.id if isinstance(node, ast.Name) else node.attr)
        elif isinstance(node, ast.alias):
            names.add(node.asname or node.name)
        elif strings and isinstance(node, ast.Constant):
            names |= set(re.findall(r"\w+", str(node.value)))
    return names


@functools.cache
def members() -> dict[str, set[str]]:
    """What each module (by its full name and by the last part of it) and each class has."""
    found: dict[str, set[str]] = defaultdict(set)
    bases: dict[str, set[str]] = defaultdict(set)
    for path in CODE:
        parts = path.relative_to(SOURCE).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        names = bound(nodes(path), strings=path.name == "__init__.py")
        for name in (".".join(parts), parts[-1]):
            found[name] |= names
        found[".".join(parts[:-1])].add(parts[-1])
        found[parts[-2] if len(parts) > 1 else ""].add(parts[-1])
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                found[node.name] |= bound(ast.walk(node))
                bases[node.name] |= {base.id for base in node.bases if isinstance(base, ast.Name)}
    for _ in range(3):
        for name in bases:
            found[name] |= set().union(*(found.get(base, set()) for base in bases[name]))
    return found


@functools.cache
def options() -> set[str]:
    """The groups and keys of the YAML files in conf/, and the fields by which commands declare options."""
    texts = [path.read_text("utf-8") for path in (SOURCE / "conf").rglob("*.yaml")]
    keys = {key for text in texts for key in re.findall(r"(\w+):(?:\s|$)", text)}
    declared = [bound(nodes(path)) for path in CODE if path.name == "options.py"]
    return keys.union(*declared) | {path.stem for path in (SOURCE / "conf").rglob("*")}


def resolves(name: str) -> bool:
    """Whether a dotted name is one of the package, of a class or preset of it, or of a library."""
    head, *rest = name.split(".")
    if head in LIBRARIES | VARIABLES | FOREIGN or {head, *rest} <= options():
        return True
    at = head
    while len(rest) > 1 and f"{at}.{rest[0]}" in members():
        at = f"{at}.{rest.pop(0)}"
    return rest[0] in members().get(at, set())


def test_dotted_names_exist() -> None:
    names = {name: match[1] for name in quoted() if (match := DOTTED.fullmatch(name))}
    assert dead(DOTTED.pattern, {name for name in names if FILE.fullmatch(name) or resolves(names[name])}) == {}


def test_classes_exist() -> None:
    assert dead(r"[A-Z]+[a-z]\w+", members().keys() | vars(builtins).keys() | FOREIGN | SETS) == {}


def test_python_files_exist() -> None:
    there = {path.relative_to(SOURCE) for path in (*CODE, *(SOURCE / "tests").rglob("*.py"))}
    ends = {"/".join(path.parts[-n:]) for path in there for n in range(1, 6)}
    assert dead(r"[\w/]+\.py", ends) == {}


def test_what_a_room_may_import() -> None:
    page = (SOURCE / "docs" / "architecture.md").read_text(encoding="utf-8")
    rules = dict(re.findall(r"^\| `(\w+)/` \|.*\| ([^|]*) \|$", page, re.MULTILINE))
    everything = {"all": MAY_IMPORT.keys(), "all but `commands`": MAY_IMPORT.keys() - {"commands"}}
    read = {
        room: everything.get(
            rule, set(re.findall(r"`(\w+)`", rule)) | set(GROUND.split() if "*ground*" in rule else ())
        )
        for room, rule in rules.items()
    }
    assert read == {room: set(allowed.split()) for room, allowed in MAY_IMPORT.items()}
