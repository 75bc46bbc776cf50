"""Networks that other libraries fetch."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch

Network = TypeVar("Network")


def pretrained(load: Callable[[], Network], name: str, publisher: str, file: str) -> Network:
    """The network that a library's own loader fetches once and keeps in torch's hub folder.

    Raises ConnectionError, saying what to put where, where it cannot be fetched.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of each attempt; the last one's error says it all
            network = load()
    except (RuntimeError, OSError) as error:
        cause = str(error.__cause__ or error).splitlines()[0]
        raise ConnectionError(
            f"the weights of {name} cannot be loaded ({cause}). They are not part of this project: run once with "
            f"access to {publisher}, or copy its {file} to {Path(torch.hub.get_dir()) / 'checkpoints' / file}"
        ) from error
    return network
