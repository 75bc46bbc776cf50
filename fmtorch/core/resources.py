"""Where the configuration files and the learned files are, in a checkout and in an installed wheel."""

from __future__ import annotations

import os
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
STAGES: dict[str, str | list[str]] = {
    "features": "sift", "matcher": "nearest", "pruner": ["ratio", "one_to_one"], "estimator": "ransac",
}  # fmt: skip
"""The groups of presets that a pipeline chooses from, with what stands where nothing is chosen."""


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


def cache_dir() -> Path:
    """Where generated data and features are kept: $FMTORCH_CACHE, or fmtorch in the user's cache folder."""
    chosen = os.environ.get("FMTORCH_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fmtorch"
