"""Some pairs of a data set, as a data set of their own."""

from pathlib import Path

import numpy as np

from fmtorch.data import DepthDataset, PairDataset, load
from fmtorch.data.pairs import subset
from fmtorch.scenes import Plan, RenderedPairs
from tests.conftest import shared_path


def test_pairs_digest_and_depth(tmp_path: Path) -> None:
    dataset = RenderedPairs(root=tmp_path, plan=Plan(1, 3, 2, scale=0.2), families=["indoor"], workers=1)
    part = subset(dataset, [len(dataset) - 1])
    assert isinstance(part, PairDataset)
    assert isinstance(part, DepthDataset)
    assert [pair.identity for pair in part] == [dataset[len(dataset) - 1].identity]
    assert part.digest != dataset.digest
    assert part.digest != subset(dataset, [0]).digest or len(dataset) == 1
    x = np.array([[40.0, 30.0], [10.0, 70.0]])
    assert np.array_equal(part.depth(part[0].image0, x), dataset.depth(part[0].image0, x), equal_nan=True)


def test_a_data_set_without_depth_stays_one() -> None:
    part = subset(load("fmbench", root=shared_path("data/TanksLike")), [3, 1])
    assert not isinstance(part, DepthDataset)
    assert len(part) == 2
