"""Where the configuration files and the learned files are, in a checkout and in an installed wheel."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Network = TypeVar("Network")

_PACKAGE = Path(__file__).resolve().parents[1]


def _folder(name: str) -> Path:
    checkout = _PACKAGE.parent if (_PACKAGE.parent / "pyproject.toml").is_file() else _PACKAGE
    for folder in (_PACKAGE / name, checkout / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no folder {name!r} in {_PACKAGE} or beside it: the installation is incomplete")


def conf_dir() -> Path:
    """The folder of Hydra groups."""
    return _folder("conf")


def models_dir() -> Path:
    """The folder of shipped networks and other learned files."""
    return _folder("models")


def pretrained(load: Callable[[], Network], name: str, publisher: str, file: str) -> Network:
    """The network that a library's own loader fetches once and keeps in torch's hub folder.

    Raises ConnectionError, saying what to put where, where it cannot be fetched.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of each attempt; the last one's error says it all
            network = load()
    except (RuntimeError, OSError) as error:
        import torch

        cause = str(error.__cause__ or error).splitlines()[0]
        raise ConnectionError(
            f"the weights of {name} cannot be loaded ({cause}). They are not part of this project: run once with "
            f"access to {publisher}, or copy its {file} to {Path(torch.hub.get_dir()) / 'checkpoints' / file}"
        ) from error
    return network


def cache_dir() -> Path:
    """Where generated data and features are kept: $FMTORCH_CACHE, or fmtorch in the user's cache folder."""
    chosen = os.environ.get("FMTORCH_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fmtorch"
