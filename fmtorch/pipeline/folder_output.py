"""Where the matches of a folder go, and whose they are."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmtorch.core.settings import claim

RECORD = "export.json"


def default_output(folder: Path) -> Path:
    """``matches/NAME``, with some digits behind where that holds the matches of another folder of this name."""
    output = Path("matches") / folder.absolute().name
    with contextlib.suppress(OSError, ValueError):
        images = json.loads((output / RECORD).read_text(encoding="utf-8"))["images"]
        if images != str(folder.absolute()):
            digest = hashlib.blake2b(str(folder.absolute()).encode(), digest_size=4).hexdigest()
            return output.with_name(f"{output.name}-{digest}")
    return output


def open_folder(output: Path, identity: Mapping[str, Any]) -> Path:
    """The folder for what is found of pairs, in `output`; the identity is kept beside it.

    Raises ValueError where the output holds results of another identity.
    """
    claim(output / RECORD, identity, "matches", "choose another output, or delete the folder", alone=False)
    return output / "export"
