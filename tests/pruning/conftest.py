"""Real matches that several pruners are tested on."""

import pytest
import torch
from torch import Tensor

from fmtorch import data, presets
from fmtorch.core import Correspondences
from fmtorch.geometry import sampson
from fmtorch.pipeline import Pipeline
from tests.conftest import shared_path


@pytest.fixture(scope="session")
def real_matches() -> list[tuple[Correspondences, Tensor]]:
    """Pairs' SIFT matches after the ratio test, one a location; and which (1, N) are within 2 px of the true F."""
    dataset = data.load("fmbench", root=shared_path("data/Strecha_train"))
    pruners = {name: presets.build("pruner", name) for name in ("ratio", "one_to_one")}
    sift = presets.build("features", "sift", max_features=2000)
    front = Pipeline(sift, presets.build("matcher", "nearest"), pruners, presets.build("estimator", "ransac"))
    matches = []
    for i in range(0, 60, 24):
        c = front.correspondences([dataset[i]])[0].correspondences
        F = torch.from_numpy(dataset[i].F)[None]
        matches.append((c, sampson(F, c.x0.double(), c.x1.double()) < 2))
    return matches
