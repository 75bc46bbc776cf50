"""Recall curves: what they show, of which pairs, in a page and in a file of their own."""

import re
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pytest

from fmtorch.core import pair_key
from fmtorch.evaluation.curves import picture, svg
from fmtorch.runs import PairRow, to_table


def table(*families: str, nsgd: float = 0.03) -> pa.Table:
    rows = [
        PairRow(pair=f"{f}{i}", key=pair_key(f"{f}{i}"), family=f, scene="s", ok=True, nsgd=nsgd * i, F=[0.1] * 9)
        for f in families
        for i in range(6)
    ]
    return to_table(rows)


@pytest.mark.parametrize(
    ("families", "curves"),
    [(["a", "b & <c>"], ["all", "a", "b & <c>"]), (["a"], ["a"]), ([], []), ([f"f{i}" for i in range(20)], None)],
)
def test_a_run_has_a_picture_of_all_and_of_each_family(families: list[str], curves: list[str] | None) -> None:
    """The legend stands beside the curves and within the picture, however many there are."""
    root = ElementTree.fromstring(picture("a & b", table(*families)))
    width, height = map(float, root.attrib["viewBox"].split()[2:])
    texts = {text.text: text for text in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"a & b", "recall [%] at 0.05"} <= texts.keys()
    legend = {str(text).partition(" ")[2]: element for text, element in texts.items() if " " in str(text)}
    for name in curves if curves is not None else ["all", *families]:
        place = legend[name].attrib
        assert 340 < float(place["x"]) < width
        assert 0 < float(place["y"]) < height
    assert "var(" not in ElementTree.tostring(root, encoding="unicode")


def test_a_curve_is_the_share_of_pairs_below_each_threshold() -> None:
    plot = svg("t", {"run": np.array([0.01, 0.06, 0.1501, 1.0])}, ["run"])
    (line,) = re.findall(r' d="M([^"]+)"', plot)
    x, y = np.array([point.split(",") for point in line.split("L")], float).T
    share = (y[0] - y) / (y[0] - 10)  # the margin at the top
    threshold = (x - x[0]) / (x[-1] - x[0]) * 0.2
    for at, expected in ((0.005, 0), (0.05, 0.25), (0.1, 0.5), (0.15, 0.5), (0.155, 0.75), (0.2, 0.75)):
        assert np.interp(at, threshold, share) == pytest.approx(expected, abs=1e-3)
