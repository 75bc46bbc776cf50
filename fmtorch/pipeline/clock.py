"""How long the steps of a pipeline take."""

from __future__ import annotations

import time

import torch


class Clock:
    """The seconds between its calls."""

    def __init__(self, device: torch.device) -> None:
        self._device, self._last = device, time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, step: str, seconds: float | None = None) -> None:
        """The time since the last call was spent on `step`, which counts for `seconds` where they are given."""
        synchronise(self._device)
        now = time.perf_counter()
        self.seconds[step] = now - self._last if seconds is None else seconds
        self._last = now


def synchronise(device: torch.device) -> None:
    """Wait for what a GPU is still doing."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
