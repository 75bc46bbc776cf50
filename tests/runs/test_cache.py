"""Arrays on disk: whole or absent, bounded, shared by processes, and never trusted."""

from pathlib import Path

import numpy as np
import pytest

from fmtorch.runs import ArrayCache


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.999])
def test_a_truncated_file_counts_as_absent(tmp_path: Path, keep: float) -> None:
    cache = ArrayCache(tmp_path)
    cache.write("some", "name", {"a": np.arange(1000)})
    path = tmp_path / "some" / "name.npz"
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.warns(UserWarning, match=r"name\.npz is damaged"):
        assert cache.read("some", "name") is None
    cache.write("some", "name", {"a": np.arange(3)})
    cached = cache.read("some", "name")
    assert len(cached["a"]) == 3
