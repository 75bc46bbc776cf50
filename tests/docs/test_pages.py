"""The examples of the pages give what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("page", ["conventions.md"])
def test_the_examples_of_a_page_run(page: str) -> None:
    failed, attempted = doctest.testfile(str(DOCS / page), module_relative=False)
    assert attempted > 0
    assert failed == 0


@pytest.mark.parametrize("module", [
    "data", "geometry.eight_point", "geometry.epipolar", "geometry.homography", "geometry.homography_pose",
    "geometry.homography_refine", "geometry.seven_point", "geometry.two_view_covariance", "metrics.nsgd",
    "metrics.recall", "pipeline.configuration", "pipeline.essential", "pipeline.fundamental", "pipeline.two_images",
])  # fmt: skip
def test_the_examples_of_docstrings_run(module: str) -> None:
    failed, attempted = doctest.testmod(importlib.import_module(f"fmtorch.{module}"))
    assert attempted > 0
    assert failed == 0
