"""Which pairs of the rendered scenes can be matched at all: the record of what the paper's rule has decided."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from fmtorch.data.matchable import Keypoints, keypoints, matchable

__all__ = ["RECORD", "Keypoints", "keypoints", "matchable", "recorded_pairs"]

RECORD = Path(__file__).with_name("pairs.json")


@functools.cache
def recorded_pairs() -> dict[str, dict[str, dict[str, Any]]]:
    """What the rule for pairs has decided: by digest and scene the number of photographs and the pairs.

    Drawn and judged once by ``scripts/record_rendered_pairs.py``; with other versions of the generator or of OpenCV,
    whose digests are not here, it is judged anew.
    """
    record: dict[str, dict[str, dict[str, Any]]] = json.loads(RECORD.read_text(encoding="utf-8"))
    return record
