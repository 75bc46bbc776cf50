"""`scripts/benchmark known_models`: the cameras of a triangulated model are the true ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scripts.benchmark.known_models import triangulate
from scripts.benchmark.verify_scenes import read_scene

from fmtorch.data import load, read_image
from fmtorch.data.overlap import overlap_of
from fmtorch.data.scenes import ScenePairs


@pytest.mark.slow
def test_a_scene_is_triangulated_with_its_own_cameras(tmp_path: Path) -> None:
    """The stereo pair, which has no point that three images see."""
    pytest.importorskip("pycolmap")
    pair = load("stereo")[0]
    assert pair.K0 is not None
    assert pair.K1 is not None
    assert pair.R is not None
    assert pair.t is not None
    images = tmp_path / "scene/Images"
    images.mkdir(parents=True)
    for i, source in enumerate((pair.image0, pair.image1)):
        cv2.imwrite(str(images / f"{i:08d}.png"), read_image(source)[..., ::-1])
    identity = np.concatenate([pair.K0.ravel(), np.eye(3).ravel(), np.zeros(3)])
    np.savetxt(
        tmp_path / "scene/Camera.txt", [identity, np.concatenate([pair.K1.ravel(), pair.R.ravel(), pair.t])]
    )  # fmt: skip
    assert triangulate(read_scene(tmp_path / "scene"), tmp_path / "models/scene") == (0, 0)
    dataset = load("colmap", root=tmp_path / "models/scene", pairs=None)
    assert isinstance(dataset, ScenePairs)
    assert min(np.abs(dataset[0].F - pair.F).max(), np.abs(dataset[0].F + pair.F).max()) < 1e-9
    assert overlap_of(dataset).of((0, 0, 1)) == 0
