"""`scripts.benchmark learned`: its tables, and other trainings of a network beside the shipped one."""

import argparse
from pathlib import Path

import pytest

from scripts.benchmark import learned, learned_table

METHODS = {"ratio": None, "LC, F": None, "seed 1": "LC, F"}
FAMILIES = {"Strecha": 0.004, "KITTI": 0.02}  # NSGD of the shipped network


def row(family: str, i: int, method: str, use: str, estimator: str, nsgd: float) -> dict:
    return {
        "pair": f"{family}/{i}", "family": family, "scene": f"{i % 3}", "ok": True, "nsgd": nsgd, "inlier_rate": 0.9,
        "inlier_rate_before": 0.8, "corrs": 10, "corrs_before": 20, "use": use, "method": method,
        "estimator": estimator, "features": "sift", "ms": 1.0, "ms_estimator": 1.0, "training_of": METHODS[method],
    }  # fmt: skip


def some_rows() -> list[dict]:
    """Thirty pairs of each family. The other training is worse by some 0.01 on wide baselines, equal on short ones."""
    return [
        row(family, i, method, use, estimator, nsgd + worse * (0.01 + 0.0002 * i))
        for use, estimator in (("hard", "ransac_eight_point"), ("prior", "fmtorch"))
        for family, nsgd in FAMILIES.items() for i in range(30) for method in METHODS
        for worse in [method == "seed 1" and family == "Strecha"]
    ]  # fmt: skip


def test_other_trainings_stand_apart() -> None:
    sheets = learned_table.tables(some_rows())
    *main, hard, prior = sheets
    assert all("seed 1" not in {line[0] for line in sheet.rows} for sheet in main)
    for sheet in (hard, prior):
        assert [line[0] for line in sheet.rows] == ["LC, F", "seed 1"]
        assert [c for c in sheet.columns if "R.05" in c] == ["real, wide (30): R.05", "real, short (30): R.05"]
        shipped, other = sheet.rows
        assert shipped[1:4] == ["100.0", "92.0", ""]  # area of a step at 0.004 up to 0.05
        assert other[1:3] == ["100.0", "66.2"]
        assert other[3].startswith("-25.8 [")
        assert shipped[5] == other[5]


def test_features_are_not_mixed() -> None:
    """The shipped network on other features of the same pairs is not what its other trainings are compared with."""
    others = [{**r, "features": "hardnet", "nsgd": 0.5} for r in some_rows() if r["training_of"] is None]
    assert learned_table.tables(some_rows() + others)[-2:] == learned_table.tables(some_rows())[-2:]


def test_trainings_are_compared_on_pairs_that_all_have() -> None:
    rows = [r for r in some_rows() if not (r["method"] == "seed 1" and r["pair"].endswith("3"))]
    hard = learned_table.tables(rows)[-2]
    assert "real, wide (27): R.05" in hard.columns


@pytest.mark.parametrize("text", ["seed 1", "=x", "seed 1=/no/such/file", "seed 1=lc_side:/no/such/file"])
def test_a_network_needs_a_name_and_a_file(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=r"NAME=\[PRESET:\]FILE"):
        learned._named(text)


def test_a_network_may_be_of_any_preset(tmp_path: Path) -> None:
    file = tmp_path / "a:b.safetensors"
    file.touch()
    assert learned._named(f"seed 1={file}") == ("seed 1", "lc", str(file))
    assert learned._named(f"seed 1=lc_side:{file}") == ("seed 1", "lc_side", str(file))
