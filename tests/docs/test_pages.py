"""Pages: examples give what they say, links lead somewhere, pages are short, generated ones are current."""

from __future__ import annotations

import doctest
import importlib
import re
from pathlib import Path

import pytest

from scripts import draw_reference

SOURCE = Path(__file__).resolve().parents[2]
DOCS = SOURCE / "docs"
PAGES = [*sorted(SOURCE.glob("*.md")), *sorted(DOCS.rglob("*.md")), *sorted((SOURCE / "models").glob("*.md"))]
MAX_WORDS = {
    SOURCE / "README.md": 1000,
    DOCS / "architecture.md": 1200,
    DOCS / "concepts" / "related.md": 800,
    **dict.fromkeys(sorted((DOCS / "benchmarks").glob("*.md")), 800),
}
"""Of a page with its tables; what does not fit is for docs/appendix."""


def relative(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


@pytest.mark.parametrize("page", MAX_WORDS, ids=relative)
def test_a_page_is_short(page: Path) -> None:
    assert len(page.read_text(encoding="utf-8").split()) <= MAX_WORDS[page]


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    files = [target for target in targets if target and not re.match(r"[a-z]+:", target)]
    assert [target for target in files if not (page.parent / target).exists()] == []


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=relative)
def test_a_page_is_on_the_map(page: Path) -> None:
    """docs/index.md links to it, or its contents list it."""
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    name = page.relative_to(DOCS).with_suffix("").as_posix()
    assert page.name == "index.md" or page.parent.name == "appendix" or f"({name}.md)" in index


@pytest.mark.parametrize("name", ["presets", "command_line"])
def test_a_generated_page_is_current(name: str) -> None:
    page = {"presets": draw_reference.presets_page, "command_line": draw_reference.commands_page}[name]()
    written = (DOCS / "reference" / f"{name}.md").read_text(encoding="utf-8")
    assert written == page, "run python scripts/draw_reference.py"


@pytest.mark.parametrize("page", ["concepts/conventions.md", "concepts/three_laws.md"])
def test_the_examples_of_a_page_run(page: str) -> None:
    failed, attempted = doctest.testfile(str(DOCS / page), module_relative=False)
    assert attempted > 0
    assert failed == 0


@pytest.mark.parametrize("module", [
    "data", "geometry.eight_point", "geometry.epipolar", "geometry.homography", "geometry.homography_pose",
    "geometry.homography_refine", "geometry.seven_point", "geometry.two_view_covariance", "metrics.nsgd",
    "metrics.recall", "two_view.pair_type", "two_view.find",
    "pipeline.two_images", "pipeline.verification",
])  # fmt: skip
def test_the_examples_of_docstrings_run(module: str) -> None:
    failed, attempted = doctest.testmod(importlib.import_module(f"fmtorch.{module}"))
    assert attempted > 0
    assert failed == 0
