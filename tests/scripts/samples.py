"""Pairs and rows for the tests of benchmarks, and the benchmarks as commands."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from fmtorch.core import Correspondences
from fmtorch.data import ImagePair, ImageSource
from fmtorch.pipeline import Outcome
from scripts.benchmark import __main__
from scripts.benchmark.runner import Item, Row


def pair(name: str, F: np.ndarray | None = None, **known: np.ndarray) -> ImagePair:
    """Of ``family/scene/number``; its images are not looked at."""
    family, scene, _ = name.split("/")
    image = ImageSource("none", Path("none.png"))
    return ImagePair(name, family, scene, image, image, np.eye(3) if F is None else F, **known)


def item(pair: ImagePair, c: Correspondences) -> Item:
    sized = c if c.size0 is not None else c.replace(size0=torch.tensor([[600, 800]]), size1=torch.tensor([[600, 800]]))
    return Item(pair, lambda: Outcome(pair, (c.mask.shape[1],) * 2, sized))


def row(method: str, pair: str, nsgd: float = 0.01, seed: int = 0, **others: object) -> Row:
    family, scene, _ = pair.split("/")
    place = {"method": method, "pair": pair, "family": family, "scene": scene, "seed": seed, "identity": ""}
    return {**place, "nsgd": nsgd, "ok": True, "ms": 1.0, "ms_pruning": 0.5, **others}


def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: object) -> str:
    monkeypatch.setattr(sys, "argv", ["benchmark", *map(str, arguments)])
    __main__.main()
    return capsys.readouterr().out


def read(path: Path) -> list[Row]:
    return [json.loads(line) for line in path.read_text().splitlines()]
