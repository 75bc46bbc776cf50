"""The road of a pair: few files from `find_fundamental` to the solver, and little else in the process."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import fmtorch
from fmtorch.estimators import SevenPoint
from tests.laws import scene

PACKAGE = Path(fmtorch.__file__).parent
PAGE = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
MAX_FILES, MAX_MODULES = 6, 92
ELSEWHERE = (
    "PIL", "cv2", "hydra", "kornia", "matplotlib", "omegaconf", "onnxruntime", "pyarrow", "scipy.sparse", "skimage"
)  # fmt: skip
ESTIMATES = """
import sys, torch, fmtorch
x0 = 500 * torch.rand(60, 2, generator=torch.Generator().manual_seed(0))
fmtorch.find_fundamental(x0, x0 + torch.rand(60, 2, generator=torch.Generator().manual_seed(1)), size0=(500, 500),
                         size1=(500, 500))
print(*sys.modules)
"""


def test_the_road_of_a_pair_is_the_files_that_the_page_names(monkeypatch: pytest.MonkeyPatch) -> None:
    solve, road = SevenPoint.minimal, list[str]()

    def solver(*arguments: Any) -> int:
        frame: Any = sys._getframe()
        while road[:1] != ["two_view/find.py"]:
            file = Path(frame.f_code.co_filename)
            if file.is_relative_to(PACKAGE):
                road.insert(0, file.relative_to(PACKAGE).as_posix())
            frame = frame.f_back
        return solve(*arguments)

    monkeypatch.setattr(SevenPoint, "minimal", staticmethod(solver))
    c = scene(0, 60)
    fmtorch.find_fundamental(c.x0, c.x1)
    files = [*dict.fromkeys(road), _file(solve)]
    paragraph = PAGE[PAGE.index("**The road of a pair**") :].split("\n\n")[0]
    assert files == re.findall(r"`([\w/]+\.py)`", paragraph)
    assert len(files) <= MAX_FILES


def _file(function: Callable[..., Any]) -> str:
    return str(Path(sys.modules[function.__module__].__file__ or "").relative_to(PACKAGE).as_posix())


def test_a_process_that_estimates_loads_what_that_needs() -> None:
    done = subprocess.run([sys.executable, "-c", ESTIMATES], capture_output=True, text=True, check=True)
    modules = done.stdout.split()
    assert [name for name in ELSEWHERE if name in modules] == []
    assert len([name for name in modules if name.partition(".")[0] == "fmtorch"]) <= MAX_MODULES, done.stderr
