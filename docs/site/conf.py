"""The documentation as a site: sphinx-build -W -c docs/site . docs/site/build (extra `docs`)."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import fmtorch

project = "fmtorch"
author = "the fmtorch authors"
version = release = fmtorch.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/index"  # the source folder is the repository, so that links between pages work there, too
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/*.md",
    "docs/*/*.md",
    "models/*.md",
    "docs/notebooks/*.ipynb",
]
source_suffix = {".md": "markdown", ".ipynb": "markdown"}
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["myst.header", "ref.python"]  # a dimension may have the name of a field

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = "fmtorch"
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["copy.js"]

FRONT = """<!doctype html><meta charset="utf-8"><title>fmtorch</title>
<meta http-equiv="refresh" content="0; url=docs/index.html"><a href="docs/index.html">fmtorch</a>
"""


def _notebook(app: object, docname: str, source: list[str]) -> None:
    """A notebook as a page: its text, its code, and what that gave when it was last run."""
    if not docname.startswith("docs/notebooks/"):
        return
    parts = []
    for cell in json.loads(source[0])["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            pictures = [kind for kind in data if kind.startswith("image/")]
            if pictures:
                parts.append(f'<img alt="" src="data:{pictures[0]};base64,{"".join(data[pictures[0]]).strip()}">')
            elif shown := "".join(output.get("text", data.get("text/plain", ""))).rstrip():
                parts.append(f"```text\n{shown}\n```")
    source[0] = "\n\n".join(parts)


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


def _fields(app: object, what: str, name: str, obj: Any, options: object, lines: list[str]) -> None:
    """What a record's docstring says of its fields, ``name, name: text.``, as a list with types and defaults."""
    if what != "class" or not dataclasses.is_dataclass(obj):
        return
    fields = {field.name: field for field in dataclasses.fields(obj)}
    listed = "|".join(fields)
    text = " ".join(line.strip() or "\0" for line in lines)
    said = re.split(rf"(?<!\S)((?:{listed})(?:, (?:{listed}))*(?: \([^()]*\))?): ", text)
    about = {}
    for names, words in zip(said[1::2], said[2::2], strict=True):
        about[names] = words.partition("\0")[0].strip()
    rest = [said[0], *(words.partition("\0")[2] for words in said[2::2])]
    paragraphs = [part.strip() for each in rest for part in each.split("\0") if part.strip()]
    entries = []
    for names, words in about.items():
        first = re.split(r"[ ,]", names)[0]
        entries += [f"- `{names}` : ``{_type(fields[first].type)}``", f"  -- {words}"]
    named = {name for names in about for name in re.findall(r"\w+", names)}
    entries += [f"- `{key}` : ``{_type(field.type)}``" for key, field in fields.items() if key not in named]
    lines[:] = [line for part in paragraphs for line in (part, "")] + entries + [""]


def _signature(
    app: object, what: str, name: str, obj: Any, options: object, signature: str | None, returned: str | None
) -> tuple[str | None, str | None] | None:
    """Shapes and arrays as a reader knows them; a record's fields are a list below."""
    if what == "class" and dataclasses.is_dataclass(obj):
        return "", None
    return _readable(signature), _readable(returned)


def _readable(text: str | None) -> str | None:
    if text is None:
        return None
    text = text.replace("Tensor | ndarray[tuple[Any, ...], dtype[Any]] | Sequence[Any]", "Arrays")
    shaped = re.compile(r"~?(?:jaxtyping\.)?(\w+)\[Tensor, '([^']*)'\]")
    return shaped.sub(lambda found: f"{found[1]}[{', '.join(found[2].replace('#', '').split())}]", text)


def _type(annotation: Any) -> str:
    """``Float (b, n, 2)`` of ``Float[Tensor, "b n 2"]``."""
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
    text = re.sub(r"Annotated\[(.*), \w+\]", r"\1", text)
    return re.sub(
        r"(\w+)\[Tensor, ['\"]([^'\"]*)['\"]\]", lambda match: f"{match[1]} ({', '.join(match[2].split())})", text
    )


def _front(app: Any, error: Exception | None) -> None:
    """The site's own index.html, which leads to the first page."""
    if error is None and app.builder.format == "html":
        (Path(app.outdir) / "index.html").write_text(FRONT, encoding="utf-8")


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _notebook)
    app.connect("autodoc-process-docstring", _fields, priority=100)
    app.connect("autodoc-process-signature", _signature)
    app.connect("build-finished", _front)
    app.connect("autodoc-process-docstring", _plain_text, priority=1000)
