"""What values an argument may have, beyond its shape: of matches, and of image sizes.

Each is checked where a user's tensors come in, all at once, so that a GPU is asked but once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from fmtorch.core.types import Correspondences

PER_MATCH: dict[str, tuple[Callable[[Any], Any], str]] = {
    "prior": (lambda prior: (prior >= 0) & (prior <= 1), "it is P(inlier), within [0, 1]"),
    "noise": (lambda noise: noise > 0, "it is a standard deviation, positive"),
}
"""Which values of a match are right, in a tensor or an array, and what is said of others. NaN is never right."""
SIZE = "image sizes (h, w) are positive"


def wrong_values(c: Correspondences, mask: Bool[Tensor, "b n"]) -> dict[str, Int[Tensor, " b"]]:
    """How many values of each argument are wrong, in each pair; in slots other than `mask` nothing is."""
    wrong = {}
    for name, (right, _) in PER_MATCH.items():
        value = getattr(c, name)
        if value is not None:
            wrong[name] = (mask & ~right(value.detach())).sum(1)
    for name in ("size0", "size1"):
        value = getattr(c, name)
        if value is not None:
            wrong[name] = (~right_size(value)).sum(1)
    return wrong


def reason(wrong: dict[str, int]) -> str:
    """What is said of a pair with so many wrong values of each argument; empty where there is none."""
    for name, count in wrong.items():
        if count and name in PER_MATCH:
            return f"{name} of {count} match{'' if count == 1 else 'es'} is wrong: {PER_MATCH[name][1]}"
        if count:
            return f"{name} is wrong: {SIZE}"
    return ""


def expect_values(c: Correspondences) -> None:
    """Raises ValueError naming the first wrong value of the real matches of a batch."""
    wrong = wrong_values(c, c.mask)
    if not wrong or not bool(torch.stack(list(wrong.values())).any()):
        return
    for name, (right, rule) in PER_MATCH.items():
        if name in wrong and bool(wrong[name].any()):
            pair, match = (c.mask & ~right(getattr(c, name))).nonzero()[0].tolist()
            value = getattr(c, name)[pair, match].item()
            raise ValueError(f"{name} of match {match} of pair {pair} is {value}; {rule}")
    expect_sizes(size0=c.size0, size1=c.size1)


def expect_sizes(**sizes: Tensor | None) -> None:
    """Raises ValueError naming the argument and the first size that is not positive and finite."""
    given = {name: size for name, size in sizes.items() if size is not None}
    if all(bool(right_size(size).all()) for size in given.values()):
        return
    for name, size in given.items():
        rows = size.detach().reshape(-1, size.shape[-1])
        for row in rows[~right_size(rows).all(-1)].tolist():
            raise ValueError(f"{name} is {tuple(row)}; {SIZE}")


def right_size(size: Any) -> Any:
    """Which numbers of image sizes are right; of a tensor or an array."""
    return (size > 0) & (size < torch.inf)
