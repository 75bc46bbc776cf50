"""docs/architecture.md tells the rules of the rooms as they are; tests/test_road.py holds its road of a pair."""

import re
from pathlib import Path

from tests.test_imports import GROUND, MAY_IMPORT

SOURCE = Path(__file__).resolve().parents[2]
PAGE = (SOURCE / "docs" / "architecture.md").read_text(encoding="utf-8")


def test_what_a_room_may_import() -> None:
    rules = dict(re.findall(r"^\| `(\w+)/` \|.*\| ([^|]*) \|$", PAGE, re.MULTILINE))
    everything = {"all": MAY_IMPORT.keys(), "all but `commands`": MAY_IMPORT.keys() - {"commands"}}
    read = {
        room: everything.get(
            rule, set(re.findall(r"`(\w+)`", rule)) | set(GROUND.split() if "*ground*" in rule else ())
        )
        for room, rule in rules.items()
    }
    assert read == {room: set(allowed.split()) for room, allowed in MAY_IMPORT.items()}
