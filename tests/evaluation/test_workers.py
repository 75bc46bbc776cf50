"""Workers that are processes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from fmtorch import presets
from fmtorch.data.pairs import ImagePair, ImageSource
from fmtorch.evaluation.run import evaluate_pairs
from fmtorch.pipeline import Pipeline
from fmtorch.storage import PairRow


def _ends() -> Pipeline:
    os._exit(3)


def test_a_process_that_ends_is_told() -> None:
    images = [ImageSource(f"scene/{i}", Path(f"{i}.png")) for i in range(3)]
    pairs = [ImagePair(f"scene/0-{i}", "family", "scene", images[0], images[i], np.eye(3)) for i in (1, 2)]
    rows: list[PairRow] = []
    run = evaluate_pairs(
        presets.pipeline("sift_ratio"), pairs, seed=0, batch=1, workers=2, store=rows.extend, build=_ends
    )
    with pytest.raises(RuntimeError, match="the same command goes on"):
        list(run)
    assert rows == []
