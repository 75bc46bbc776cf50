"""`python -m fmtorch.storage [DIR]`: what the feature cache holds."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from fmtorch.resources import cache_dir
from fmtorch.storage.cache import ArrayCache


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m fmtorch.storage", description="What the feature cache holds.")
    parser.add_argument("folder", nargs="?", type=Path, default=cache_dir() / "features", metavar="DIR")
    folder: Path = parser.parse_args().folder
    sizes: dict[str, list[int]] = {}
    for path, status in ArrayCache(folder).files():
        sizes.setdefault(path.parent.name, []).append(status.st_size)
    table = Table(title=f"{folder}: {sum(map(len, sizes.values()))} files, {_megabytes(sum(map(sum, sizes.values())))}")
    for name in ("configuration", "files", "size"):
        table.add_column(name, justify="left" if name == "configuration" else "right")
    for section, some in sorted(sizes.items()):
        table.add_row(section, str(len(some)), _megabytes(sum(some)))
    Console().print(table)


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"


if __name__ == "__main__":
    main()
