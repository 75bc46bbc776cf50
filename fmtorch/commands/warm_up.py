"""`fmtorch warm-up`: compile all kernels now, for machines and containers on which no first call shall wait."""

import importlib
import pkgutil
import sys
import time

from fmtorch.core.terminal import console, exits_with_message
from fmtorch.jit import cache, kernel, linking
from fmtorch.jit.kernel import HOME, compile_together

USAGE = """fmtorch warm-up: compile all kernels now

usage: fmtorch warm-up

The compiled kernels are kept in $FMTORCH_CACHE/kernels (~/.cache/fmtorch/kernels). A container may hold that folder: it
serves machines with the processor, Python, numba and version of fmtorch that it was made with (about.json in it says
which); any other compiles its own."""
WITH_KERNELS = ("estimators", "geometry", "matching", "metrics", "pruning", "scenes")  # rooms


def warm_up() -> int:
    """Compile the kernels of all stages that this machine has not compiled yet; how many there are.
    Raises ValueError where kernels are switched off or cannot be kept."""
    if kernel.off():
        raise ValueError(f"kernels are switched off ({kernel.SWITCH}=off)")
    if cache.folder() is None:
        raise ValueError(f"{cache.kernels_dir()} cannot be written; set FMTORCH_CACHE to a folder that can")
    for module in pkgutil.walk_packages([str(HOME / "fmtorch")], "fmtorch."):
        if module.name.split(".")[1] in WITH_KERNELS:
            importlib.import_module(module.name)
    kernels = [each for (name, _), each in sorted(linking.KERNELS.items()) if name.startswith("fmtorch.")]
    compile_together(kernels)
    return len(kernels)


def main() -> None:
    """The command."""
    if sys.argv[1:]:
        print(USAGE)
        sys.exit(0 if sys.argv[1:] in (["--help"], ["-h"]) else 1)
    with exits_with_message():
        start = time.perf_counter()
        count = warm_up()
        seconds, processor = time.perf_counter() - start, cache.versions()["processor"]
        console.print(f"{count} kernels for {processor} in {seconds:.0f} s: {cache.folder()}", soft_wrap=True)
