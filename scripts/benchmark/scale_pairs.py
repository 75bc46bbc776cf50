"""Pairs with given matches, in the layout of the RANSAC tutorial."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from fmtorch.data.pairs import ImagePair
from fmtorch.io.dataset import H5Pairs


def given_pairs(root: Path, pairs: int, matches: int = 60, seed: int = 0, outliers: float = 0.0) -> list[ImagePair]:
    """So many pairs of one camera that moves along a random path; noise of half a pixel. outliers: their share."""
    rng = np.random.default_rng(seed)
    K = np.array([[800.0, 0, 319.5], [0, 800, 239.5], [0, 0, 1]])
    root.mkdir()
    with h5py.File(root / "matches.h5", "w") as points, h5py.File(root / "match_conf.h5", "w") as ratios:
        cameras = {name: h5py.File(root / f"{name}.h5", "w") for name in ("K1_K2", "R", "T")}
        places = rng.normal(size=(pairs + 1, 3)) * 0.5
        for image, place in enumerate(places):
            cameras["R"][f"im{image:05d}"], cameras["T"][f"im{image:05d}"] = np.eye(3), place
        for pair in range(pairs):
            X = np.column_stack([rng.uniform(-2, 2, (matches, 2)), rng.uniform(5, 9, matches)])
            x = [(X + places[image]) @ K.T for image in (pair, pair + 1)]
            x = [each[:, :2] / each[:, 2:] + rng.normal(size=(matches, 2)) * 0.5 for each in x]
            wrong = np.arange(matches) < outliers * matches
            x[1][wrong] = rng.uniform([0, 0], [640, 480], (wrong.sum(), 2))
            key = f"im{pair:05d}-im{pair + 1:05d}"
            points[key], ratios[key] = np.column_stack(x), rng.uniform(0.3, 0.9, matches)
            cameras["K1_K2"][key] = np.stack([K, K])
        for file in cameras.values():
            file.close()
    return list(H5Pairs(root, "ransac_tutorial"))
