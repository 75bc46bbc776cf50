"""Which pairs of a database an interrupted verification had finished, in a file beside it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from fmtorch.core.files import replacing

Ids = tuple[int, int]


class VerificationLog:
    """A text file: the settings, and a line of image numbers for each batch of pairs that is in the database.

    done: pairs finished with these settings; a log of others is begun again.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path, self.done = path, set[Ids]()
        first, *lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else [""]
        wanted = json.dumps(settings, sort_keys=True)
        self.continued = first == wanted
        if not self.continued:
            with replacing(path) as temporary:
                temporary.write_text(wanted + "\n", encoding="utf-8")
            return
        for line in lines:
            self.done.update(_pairs(line))

    def add(self, pairs: Iterable[Ids]) -> None:
        """Note pairs as finished, once they are in the database."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write("\n" + json.dumps(list(pairs)))

    def remove(self) -> None:
        """Remove the file."""
        self.path.unlink(missing_ok=True)


def _pairs(line: str) -> list[Ids]:
    """The pairs of a line; none of a line that was not written to its end."""
    try:
        return [(int(first), int(second)) for first, second in json.loads(line)] if line else []
    except ValueError:
        return []
