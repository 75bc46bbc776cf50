"""docs/architecture.md tells the road of a pair and the rules of the rooms as they are."""

from __future__ import annotations

import re
from pathlib import Path

from scripts.house import road
from tests.test_imports import GROUND, MAY_IMPORT

SOURCE = Path(__file__).resolve().parents[2]
PAGE = (SOURCE / "docs" / "architecture.md").read_text(encoding="utf-8")


def test_the_road_of_a_pair() -> None:
    listed = PAGE.partition("<!-- road -->")[2].partition("<!-- end of road -->")[0]
    assert re.findall(r"^(\w\S+\.py)", listed, re.MULTILINE) == [name.removeprefix("fmtorch/") for name in road()]


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
