"""The documentation as a site: sphinx-build -W -c docs/site . docs/site/build (extra `docs`)."""

from __future__ import annotations

import fmtorch

project = "fmtorch"
author = "the fmtorch authors"
version = release = fmtorch.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/index"  # the source folder is the repository, so that links between pages work there, too
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/*.md", "models/*.md"]
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
