"""Some pairs of a data set, as a data set of their own."""

from pathlib import Path

import numpy as np

from fmtorch.data import DepthDataset, PairDataset, load, subset
from tests.data.native import write_tum


def test_pairs_digest_and_depth(tmp_path: Path) -> None:
    name = write_tum(tmp_path, depth=True).name
    dataset, plain = (load("tum", root=tmp_path, sequences=[name], depth=depth) for depth in (True, False))
    part = subset(dataset, [len(dataset) - 1])
    assert isinstance(part, PairDataset)
    assert isinstance(part, DepthDataset)
    assert [pair.identity for pair in part] == [dataset[len(dataset) - 1].identity]
    assert len({part.digest, dataset.digest, subset(dataset, [0]).digest}) == 3
    x = np.array([[40.0, 30.0], [10.0, 70.0]])
    assert np.array_equal(part.depth(part[0].image0, x), dataset.depth(part[0].image0, x), equal_nan=True)
    assert not isinstance(subset(plain, [3, 1]), DepthDataset)
