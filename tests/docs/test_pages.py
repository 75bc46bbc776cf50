"""Pages: examples give what they say, links lead somewhere, pages are short, generated ones are current."""

import csv
import doctest
import importlib
import re
from pathlib import Path

import pytest

from scripts import draw_reference

SOURCE = Path(__file__).resolve().parents[2]
DOCS = SOURCE / "docs"
PAGES = [*sorted(SOURCE.glob("*.md")), *sorted(DOCS.rglob("*.md")), *sorted((SOURCE / "models").glob("*.md"))]
LIMITS = {"README.md": 1000, "docs/benchmarks": 1000, "docs/reference": 3000}  # words of a page with its tables
MAX_WORDS = 1500


def relative(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_a_page_is_short(page: Path) -> None:
    limit = LIMITS.get(relative(page), LIMITS.get(relative(page.parent), MAX_WORDS))
    assert len(page.read_text(encoding="utf-8").split()) <= limit


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    files = [target for target in targets if target and not re.match(r"[a-z]+:", target)]
    assert [target for target in files if not (page.parent / target).exists()] == []


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=relative)
def test_a_page_is_on_the_map(page: Path) -> None:
    """docs/index.md links to it."""
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    name = page.relative_to(DOCS).with_suffix("").as_posix()
    assert page.name == "index.md" or f"({name}.md)" in index


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
