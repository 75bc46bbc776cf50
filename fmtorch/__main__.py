"""`fmtorch eval pipeline=sift_ratio`, also `python -m fmtorch eval ...`: the commands by one name."""

from __future__ import annotations

import os
import runpy
import sys

from fmtorch.core.version import __version__

COMMANDS = {
    "eval": "run a pipeline over a data set of image pairs and evaluate it",
    "list": "the presets there are, of all groups or of one: fmtorch list estimator",
    "match": "the fundamental matrix of two photographs, with pictures: fmtorch match a.jpg b.jpg",
    "pairs": "which pairs of images with known cameras can be matched, as a data set",
    "report": "compare runs of eval on one HTML page",
    "train": "train a learned pruner on labelled matches of a data set",
    "verify": "two-view geometries of the matches in a COLMAP database, or hloc's files",
    "warm-up": "compile all kernels now, for images and containers",
}
HELP = f"""fmtorch {__version__}: two-view geometry

usage: fmtorch COMMAND [NAME=VALUE ...]

{chr(10).join(f"  {name:9}{what}" for name, what in COMMANDS.items())}

`fmtorch COMMAND --help` lists what a command takes; `python -m fmtorch.COMMAND` is the same command."""


def main() -> None:
    """Run the command that the first argument names."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h", "help"):
        print(HELP)
    elif name == "--version":
        print(__version__)
    elif name in COMMANDS:
        sys.argv[1:] = rest
        if sys.path[0] != os.getcwd():  # where a user's own parts are found, as by `python -m`
            sys.path.insert(0, os.getcwd())
        module = f"fmtorch.{name.replace('-', '_')}"
        runpy.run_module(module, run_name="__main__", alter_sys=True)  # as the process's own main module
    else:
        sys.exit(f"error: no command {name!r}; there are: {', '.join(COMMANDS)}")


if __name__ == "__main__":
    main()
