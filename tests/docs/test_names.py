"""Names between backquotes in docstrings and pages exist: modules, functions, classes, options of presets, files."""

import ast
import builtins
import functools
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2]
CODE = [*(SOURCE / "fmtorch").rglob("*.py"), *(SOURCE / "scripts").rglob("*.py")]
PAGES = [*SOURCE.glob("*.md"), *(SOURCE / "docs").rglob("*.md"), *(SOURCE / "models").glob("*.md")]
LIBRARIES = {
    "concurrent", "cv2", "json", "kornia", "mpi4py", "np", "numpy", "onnxruntime", "poselib", "pycolmap", "torch",
    "vismatch", "PIL",
}  # fmt: skip
VARIABLES = {"F", "c", "config", "e", "estimate", "lens", "pose", "result", "x"}  # of the examples around them
FOREIGN = {
    "CompileResult",
    "DMatch",
    "Dataset",
    "KeyPoint",
    "Path",
    "Progress",
    "TwoViewGeometry",
    "UsacParams",
}  # classes of other libraries
SETS = {"Fgt", "Strecha_train", "TanksLike"}
DOTTED = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?:\(.*)?")
FILE = re.compile(
    r"[\w.]+\.(bin|csv|db|h5|html|json|md|npz|onnx|out|partial|parts|png|py|sh|shards|svg|txt|verification)"
)


def docstrings(path: Path) -> Iterator[str]:
    """Of a module, its classes and functions, and the strings that follow constants."""
    for node in ast.walk(ast.parse(path.read_bytes())):
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


def bound(tree: ast.AST, strings: bool = False) -> set[str]:
    """The names that code defines, assigns or imports; with strings also those that it exports at first use."""
    names: set[str] = set()
    for node in ast.walk(tree):
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
        tree, parts = ast.parse(path.read_bytes()), path.relative_to(SOURCE).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        for name in (".".join(parts), parts[-1]):
            found[name] |= bound(tree, strings=path.name == "__init__.py")
        found[".".join(parts[:-1])].add(parts[-1])
        found[parts[-2] if len(parts) > 1 else ""].add(parts[-1])
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                found[node.name] |= bound(node)
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
    declared = [bound(ast.parse(path.read_bytes())) for path in CODE if path.name == "options.py"]
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
