"""Where the matches of a folder go, and whose they are."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmtorch.core.files import replacing
from fmtorch.storage.runs import canonical

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
    output.mkdir(parents=True, exist_ok=True)
    file = output / RECORD
    wanted = json.loads(canonical(identity))
    if file.exists():
        try:
            stored = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{file} is not valid JSON ({error}); delete {output} and run again") from error
        if stored != wanted:
            differing = [key for key in {**stored, **wanted} if stored.get(key) != wanted.get(key)]
            raise ValueError(
                f"{output} holds matches of other settings ({', '.join(sorted(differing))} differ); "
                "choose another output, or delete the folder"
            )
    else:
        with replacing(file) as temporary:
            temporary.write_text(json.dumps(wanted, indent=2) + "\n", encoding="utf-8")
    return output / "export"
