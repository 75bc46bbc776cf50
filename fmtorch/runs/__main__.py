"""`python -m fmtorch.runs [DIR]`: what the cache folder holds of features, compiled kernels, scenes and matches."""

import argparse
import contextlib
import shutil
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from fmtorch.core.files import cache_dir
from fmtorch.jit.cache import kernels_dir


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m fmtorch.runs", allow_abbrev=False,
        description="What the cache folder holds. Any of its folders may be deleted: what is missing is made again.",
    )  # fmt: skip
    parser.add_argument("folder", nargs="?", type=Path, default=cache_dir(), metavar="DIR")
    parser.add_argument("--clear-kernels", action="store_true", help="remove the compiled kernels of all versions")
    options = parser.parse_args()
    if options.clear_kernels and kernels_dir().is_dir():
        shutil.rmtree(kernels_dir())
    held: dict[str, list[tuple[int, float]]] = {}
    for file in sorted(options.folder.rglob("*")):
        with contextlib.suppress(FileNotFoundError):  # which another process has just removed
            if file.is_file():
                name, status = "/".join(file.parent.relative_to(options.folder).parts[:2]), file.stat()
                held.setdefault(name, []).append((status.st_size, status.st_mtime))
    table = Table("folder", title=f"{options.folder}: {sum(map(len, held.values())):,} files")
    for heading in ("files", "MB", "last used"):
        table.add_column(heading, justify="right")
    for name, files in held.items():
        sizes, times = zip(*files, strict=True)
        day = time.strftime("%Y-%m-%d", time.localtime(max(times)))
        table.add_row(name, f"{len(files):,}", f"{sum(sizes) / 1e6:,.1f}", day)
    Console(markup=False).print(table)


if __name__ == "__main__":
    main()
