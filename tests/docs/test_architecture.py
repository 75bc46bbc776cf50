"""docs/architecture.md tells the way of a seven-point sample as it is."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

import fmtorch
from fmtorch.estimators import Ransac
from tests.estimators.pairs import pair_of
from tests.laws import scene

PACKAGE = Path(fmtorch.__file__).parent
PAGE = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
PASSED_ON = {"preselection.py", "refinement.py", "selection.py"}  # models to scores and family


def short(path: str | Path) -> str:
    return Path(path).resolve().relative_to(PACKAGE).as_posix().removeprefix("estimators/")


def test_the_way_of_a_seven_point_sample_is_five_files() -> None:
    paragraph = PAGE[PAGE.index("**The way of a seven-point sample**") :].split("\n\n")[0]
    files = re.findall(r"`([\w/]+\.py)`", paragraph)
    assert len(files) == 5
    engine = Ransac(hypotheses=50, round=50, refine={"kernel": "truncated"}, final="none")
    pair, called = pair_of(scene(1, 60)), set()

    def seen(frame: Any, event: str, argument: Any) -> None:
        """The files of the functions that hold models or samples of a round."""
        local = frame.f_code.co_varnames[: frame.f_code.co_argcount]
        where = Path(frame.f_code.co_filename)
        if event == "call" and where.is_relative_to(PACKAGE / "estimators"):
            arrays = [frame.f_locals[name] for name in local if isinstance(frame.f_locals.get(name), np.ndarray)]
            if any(array.ndim == 2 and (array.shape[1] == 9 or array.shape[0] == 7) for array in arrays):
                called.add(short(where))

    sys.setprofile(seen)
    try:
        assert engine.estimate(pair).fit is not None
    finally:
        sys.setprofile(None)
    kernel = type(engine.family).minimal
    solver, drawn, search = (
        short(sys.modules[each.__module__].__file__ or "")
        for each in (getattr(kernel, "function", kernel), type(engine.sampler), type(engine.search))
    )
    assert called - PASSED_ON | {solver, drawn, search} == set(files)
