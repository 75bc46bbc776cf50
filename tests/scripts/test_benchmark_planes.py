"""Pairs made of photographs: homographies and kinds of pairs, and their commands."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from skimage import data as images

from fmtorch.geometry import homography_transfer
from fmtorch.two_view.pair_type import classify
from scripts.benchmark import planes
from tests.scripts.samples import run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for name in ("astronaut", "coffee", "chelsea", "rocket"):
        cv2.imwrite(str(folder / f"{name}.png"), getattr(images, name)()[..., ::-1])
    return folder


def test_pairs_are_of_their_kinds(folder: Path) -> None:
    items = list(planes.kinds(sorted(folder.iterdir())[:2]))
    truths = [item.facts["truth"] for item in items]
    assert truths == ["planar", "rotation", "identical", "identical", "unrelated"] * 2
    verdict = planes.Ours(known=True)
    assert [verdict(item.matches) for item in items] == truths
    c = items[1].matches
    R = classify(c, verdict.estimator(c, 0), focal_deviation=0).evidence.R
    near = homography_transfer(c.K1 @ R @ torch.linalg.inv(c.K0), c.x0.double(), c.x1.double())[1][c.mask] < 2
    assert float(near.double().mean()) > 0.5


def cells(printed: str) -> list[list[str]]:
    """Of the tables' lines."""
    return [[cell.strip() for cell in line.split("|")] for line in printed.splitlines() if line.startswith("| ")]


def test_the_commands(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    arguments = ["--photographs", folder, "--limit", 2]
    printed = run(capsys, monkeypatch, "pair_types", *arguments, "--colmap", 4)
    lines = [
        [cell.strip() for cell in line.split("|")] for line in printed.splitlines() if line.startswith("| fmtorch")
    ]
    assert [line[-2] for line in lines] == ["100.0"] * 5
    assert "COLMAP, 4 px" in printed
    methods = ["--methods", "ours", "ours:pool=6", "usac_magsac:1", "--kinds", "warped", "hard", "--seeds", 1]
    printed = run(capsys, monkeypatch, "homography", *arguments, *methods)
    lines = cells(printed)
    assert [(line[1], line[3]) for line in lines[2:]] == [(k, m) for k in ("hard", "warped") for m in methods[1:4]]
    assert all(float(line[6]) > 80 for line in lines[2:])  # AUC@5 px


def test_an_estimate_is_judged_where_the_plane_is_seen(folder: Path) -> None:
    (item,) = planes.warped(sorted(folder.iterdir())[:1], 1, hard_too=False)
    shifted = np.array([[1, 0, 3], [0, 1, 4], [0, 0, 1]]) @ item.pair.H
    errors = [planes.Homography("x", lambda c, seed, H=H: H).figures(item, 0)["corner_error"]
              for H in (item.pair.H, shifted, None)]  # fmt: skip
    assert errors == [pytest.approx(0, abs=1e-9), pytest.approx(5), np.inf]
