"""`python -m fmtorch.runs [DIR]`: what the cache folder holds of features, compiled kernels, scenes and matches."""

import argparse
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from fmtorch.core.files import cache_dir
from fmtorch.jit.cache import ABOUT, kernels_dir
from fmtorch.runs.feature_cache import ArrayCache

Sizes = Mapping[str, Sequence[int]]
OTHERS = {"rendered": "scenes drawn", "planes": "photographs as planes", "matched": "matches for training"}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m fmtorch.runs",
        description="What the cache folder holds. Any of its folders may be deleted: what is missing is made again.",
    )
    parser.add_argument("folder", nargs="?", type=Path, default=cache_dir() / "features", metavar="DIR")
    parser.add_argument("--clear-kernels", action="store_true", help="remove the compiled kernels of all versions")
    options = parser.parse_args()
    if options.clear_kernels and kernels_dir().is_dir():
        shutil.rmtree(kernels_dir())
    features: dict[str, list[int]] = {}
    for path, status in ArrayCache(options.folder).files():
        features.setdefault(path.parent.name, []).append(status.st_size)
    _show(options.folder, "configuration", features)
    _show(kernels_dir(), "version of the compiled kernels", _kernels())
    files = {f"{name}: {what}": (cache_dir() / name).rglob("*") for name, what in OTHERS.items()}
    others = {name: [file.stat().st_size for file in below if file.is_file()] for name, below in files.items()}
    _show(cache_dir(), "other folders", {name: sizes for name, sizes in others.items() if sizes})


def _kernels() -> Sizes:
    sizes = {}
    for about in kernels_dir().glob(f"*/{ABOUT}"):
        day = time.strftime("%Y-%m-%d", time.localtime(about.stat().st_mtime))
        sizes[f"{about.parent.name}, used {day}"] = [file.stat().st_size for file in about.parent.glob("*.bin")]
    return sizes


def _show(folder: Path, kind: str, sizes: Sizes) -> None:
    table = Table(title=f"{folder}: {sum(map(len, sizes.values()))} files, {_megabytes(sum(map(sum, sizes.values())))}")
    for name in (kind, "files", "size"):
        table.add_column(name, justify="left" if name == kind else "right")
    for section, sizes_of_section in sorted(sizes.items()):
        table.add_row(section, str(len(sizes_of_section)), _megabytes(sum(sizes_of_section)))
    Console(markup=False).print(table)


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"


if __name__ == "__main__":
    main()
