"""Curves of accuracy against time: what a file says, knees, table and figure."""

from __future__ import annotations

import itertools
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from fmtorch import presets
from fmtorch.data import ImagePair, ImageSource
from scripts.benchmark import curves, curves_figure, estimators, matched

FAMILIES = ("orbit", "orbit", "driving", "driving")


def _pairs() -> list[ImagePair]:
    image = ImageSource("none", Path("none.png"))  # not looked at
    return [ImagePair(f"{f}/{i}", f, f"{f}{i}", image, image, np.eye(3)) for i, f in enumerate(FAMILIES)]


def _result(nsgd: float, ms: float) -> estimators.Result:
    return {"nsgd": np.full((2, len(FAMILIES)), nsgd), "ms": np.full((2, len(FAMILIES)), ms)}


def test_every_curve_of_the_project_names_estimators_there_are() -> None:
    every_curve = curves.read(curves.SPECS)
    assert len({curve.name for curve in every_curve}) == len(every_curve)
    for curve in every_curve:
        assert len(curve.specs) == len(set(curve.specs)) > 1
        for spec in curve.specs:
            front, _, stages = spec.partition("@")
            name, _, rest = front.partition(":")
            known = presets.load("estimator", name)
            assert all(key.split(".")[0] in {*known, "focal"} for key in matched.options(rest)), spec
            assert set(filter(None, stages.split("+"))) <= set(presets.available("pruner"))


def test_a_line_of_another_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "curves.txt"
    path.write_text("# first\nmine | ransac:hypotheses={} | 10 20  # two\n\nother | ransac | 10\n")
    with pytest.raises(SystemExit, match=r"curves.txt:4: 'other \| ransac \| 10' is not CURVE"):
        curves.read(path)
    path.write_text(path.read_text().partition("other")[0])
    assert curves.read(path) == [curves.Curve("mine", ("ransac:hypotheses=10", "ransac:hypotheses=20"), ("10", "20"))]


def test_the_knee_is_the_cheapest_point_near_the_best() -> None:
    """AUC@0.05 of a pair is 1 - NSGD / 0.05: 80, 89.8 and 90 %."""
    curve = curves.Curve("<mine>", ("a", "b", "c"), ("1", "2", "3"))
    results = {"a": _result(0.01, 1.0), "b": _result(0.0051, 20.0), "c": _result(0.005, 30.0)}
    figures = curves.summaries(results, _pairs())
    assert list(figures) == ["driving", "orbit", "wide baselines", "short baselines", "all"]
    assert curves.knee(curve, figures) == "b"
    text = curves.table([curve], figures, {"<mine>": "b"}, 2)
    rows = text.splitlines()[4:]
    assert rows[1].startswith("|  | **2** | **20.0** | **100.0 / 100.0 / 89.8** |")
    assert rows[2].startswith("|  | 3 | 30.0 | 100.0 / 100.0 / 90.0 |")
    drawn = ElementTree.fromstring(curves_figure.figure({"<mine>": curve.specs}, figures, {"<mine>": "b"}))
    points = [e for e in drawn.iter() if e.tag.endswith("circle")]
    assert [p.get("class") for p in points] == [None, "knee", None] * 2  # a panel for wide and one for short baselines
    assert all(float(a.get("cx", 0)) < float(b.get("cx", 0)) for a, b in itertools.pairwise(points[:3]))
    assert "<mine>" in [e.text for e in drawn.iter() if e.tag.endswith("text")]
