"""How records show themselves: a line in a terminal, a table and a picture in a notebook."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence

MAX_ROWS = 20  # of a table in a notebook


def table_html(header: Sequence[str], rows: Sequence[Sequence[object]], caption: str) -> str:
    """An HTML table of the first rows, with a caption that is the record's line."""
    shown = [*map(_row, rows[:MAX_ROWS])]
    if len(rows) > MAX_ROWS:
        shown.append(f'<tr><td colspan="{len(header)}">and {len(rows) - MAX_ROWS} more</td></tr>')
    return f"<table><caption>{html.escape(caption)}</caption>{_row(header, 'th')}{''.join(shown)}</table>"


def picture_html(data: bytes, kind: str, title: str) -> str:
    """An image, given as the bytes of its file, within the page."""
    encoded = base64.b64encode(data).decode()
    return f'<img src="data:image/{kind};base64,{encoded}" alt="{html.escape(title)}" style="max-width: 100%">'


def _row(cells: Iterable[object], tag: str = "td") -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(str(cell))}</{tag}>' for cell in cells)}</tr>"
