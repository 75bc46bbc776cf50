"""The documentation as a site: sphinx-build -W -c docs/site . docs/site/build (extra `docs`)."""

from __future__ import annotations

import re
from typing import Any

import fmtorch

project = "fmtorch"
author = "the fmtorch authors"
version = release = fmtorch.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/index"  # the source folder is the repository, so that links between pages work there, too
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/*.md", "docs/*/*.md", "models/*.md"]
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["myst.header"]

autodoc_typehints = "none"  # shapes stand in the docstrings
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = "fmtorch"
html_copy_source = False


def _plain_text(app: object, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Docstrings are plain text: backquotes mean code, stars and bars mean themselves."""
    for i, line in enumerate(lines):
        code_and_text = re.split(r"(``[^`]+``|`[^`]+`)", line)
        for j, part in enumerate(code_and_text):
            if j % 2 == 0:
                escaped = re.sub(r"([*|]|_(?!\w))", r"\\\1", part)
                code_and_text[j] = ("\\ " if j and re.match(r"\w", part) else "") + escaped
            elif not part.startswith("``"):
                code_and_text[j] = f"`{part}`"
        lines[i] = "".join(code_and_text)


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _plain_text, priority=1000)
