"""The pairs of known kinds, their verdicts, and the command, on two photographs."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import pytest
import torch
from skimage import data as images

from fmtorch.core.types import Correspondences
from fmtorch.geometry import homography_transfer
from fmtorch.two_view.pair_type import classify
from scripts.benchmark import configuration, configuration_pairs
from scripts.benchmark.configuration import Ours, _pose_errors
from scripts.benchmark.configuration_pairs import Case
from tests.geometry.kinds import batch, draw


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for name in ("astronaut", "coffee", "chelsea", "rocket"):
        cv2.imwrite(str(folder / f"{name}.png"), getattr(images, name)()[..., ::-1])
    return folder


def test_pairs_are_of_their_kinds(folder: Path) -> None:
    cases = list(configuration_pairs.photographs(sorted(folder.iterdir())[:2]))
    assert [case.truth for case in cases] == ["planar", "rotation", "identical", "identical", "unrelated"] * 2
    verdict = Ours(known=True)
    assert [verdict(case, 0) for case in cases] == [case.truth for case in cases]
    c = cases[1].matches
    assert c.K0 is not None
    assert c.K1 is not None
    R = classify(c, verdict.estimator(c, 0), focal_deviation=0).evidence.R
    near = homography_transfer(c.K1 @ R @ torch.linalg.inv(c.K0), c.x0.double(), c.x1.double())[1][c.mask] < 2
    assert float(near.double().mean()) > 0.5


def test_the_command(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    configuration.add_arguments(parser.add_subparsers())
    pytest.importorskip("pycolmap")
    arguments = parser.parse_args(
        ["configuration", "--photographs", str(folder), "--folder", str(tmp_path), "--limit", "2", "--colmap", "4"]
    )
    arguments.run(arguments)
    first = capsys.readouterr().out
    arguments.run(arguments)  # with the matches that it kept
    assert "COLMAP, 4 px" in first
    assert _tables(first) == _tables(capsys.readouterr().out)
    assert [line.split()[-2] for line in _tables(first)[:5]] == ["100.0"] * 5


def _tables(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("│")]


def test_poses_of_a_plane() -> None:
    """From exact cameras and matches with noise: H gives the pose as one of two, F whatever it likes."""
    drawn = draw("planar", 0, wrong=0.0, noise=0.2)
    given = batch([drawn])
    fields = {name: given[name] for name in ("x0", "x1", "mask", "size0", "size1", "K0", "K1")}
    _, first, better = _pose_errors(Case(Correspondences(**fields), "planar", "", "", (drawn.R, drawn.t)))
    assert better <= first
    assert better < 2
