"""How many threads a stage computes with."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def one_thread(device: torch.device | str) -> Iterator[None]:
    """Within it torch computes with one thread on the CPU; a GPU is left alone.

    For stages of many small operations. On a busy machine several threads wait for one another at the end of each: two
    matched 6,892 x 3,461 descriptors in 6 to 16 s where one needs 0.5 s, and estimated twenty times as slowly.
    """
    before = torch.get_num_threads()
    if torch.device(device).type != "cpu" or before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
