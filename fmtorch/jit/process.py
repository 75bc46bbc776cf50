"""`python -m fmtorch.jit.process MODULE`: the `main` of a module that needs no torch, a second sooner.

Packages import torch in their `__init__`, which modules of kernels, of NumPy and of OpenCV alone do not need.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from pathlib import Path

HOME = Path(__file__).resolve().parents[2]


def cores() -> int:
    """How many processor cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def start(module: str, **environment: str) -> subprocess.Popen[str]:
    """A Python process that runs the `main` of a module, with pipes for its standard input and output.

    module: its full name, as in ``import``. environment: variables besides those of this process. Raises OSError where
    it cannot be started.
    """
    path = os.pathsep.join([str(HOME), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-m", "fmtorch.jit.process", module],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **environment, "PYTHONPATH": path},
    )  # fmt: skip


def _open_packages() -> None:
    """Let modules of fmtorch be imported without the `__init__` of the packages they are in."""
    for init in (HOME / "fmtorch").glob("*/**/__init__.py"):
        folder = init.parent
        spec = ModuleSpec(".".join(folder.relative_to(HOME).parts), None, is_package=True)
        spec.submodule_search_locations = [str(folder)]
        sys.modules.setdefault(spec.name, module_from_spec(spec))


if __name__ == "__main__":
    _open_packages()
    importlib.import_module(sys.argv[1]).main()
