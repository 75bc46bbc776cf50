"""The commonest reasons of failure: those that differ in numbers or names alone are one reason."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence

_NUMBER = re.compile(r"(\d+(?:\.\d+)?)([;,:.]?)")


def common_reasons(reasons: Sequence[str], count: int) -> dict[str, int]:
    """At most `count` reasons with the number of their pairs, the commonest first.

    Reasons whose words are equal but for those with digits are one, which shows the range of numbers and what names
    have in common: "5 to 7 matches; at least 8 are needed", "no image scene/0000….png".
    """
    kinds: dict[tuple[str, ...], list[list[str]]] = {}
    for reason in reasons:
        words = reason.split()
        kinds.setdefault(tuple("" if re.search(r"\d", word) else word for word in words), []).append(words)
    common = Counter({kind: len(alike) for kind, alike in kinds.items()}).most_common(count)
    return {" ".join(_merged(column) for column in zip(*kinds[kind], strict=True)): n for kind, n in common}


def _merged(words: Sequence[str]) -> str:
    """One word for those at the same place of several reasons."""
    different = sorted(set(words))
    if len(different) == 1:
        return different[0]
    numbers = [match for word in different if (match := _NUMBER.fullmatch(word))]
    if len(numbers) == len(different) and len({match[2] for match in numbers}) == 1:
        ordered = sorted((match[1] for match in numbers), key=float)
        return f"{ordered[0]} to {ordered[-1]}{numbers[0][2]}"
    head = _shared_start(different)
    tail = _shared_start([word[len(head) :][::-1] for word in different])[::-1]
    return f"{head}…{tail}"


def _shared_start(words: Sequence[str]) -> str:
    columns = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*words, strict=False))
    return "".join(letters[0] for letters in columns)
