"""Small data for labelled matches: rendered scenes at a quarter of their size, and pairs with exact geometry."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fmtorch.core import Correspondences, pair_key
from fmtorch.scenes import Plan, RenderedPairs, calibration
from fmtorch.training import LabelledMatches, MatchedPairs
from tests.conftest import own_cache
from tests.reference.solvers import skew

TINY = Plan(scenes=2, shots=4, pairs=4, scale=0.25)
FAMILY = "indoor"  # the quickest to draw
SIFT = {"pipeline": "sift_ratio", "overrides": ["pruner=[one_to_one]"]}


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder, as $FMTORCH_CACHE names one, in which the scenes of `rendered` are."""
    return own_cache(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def rendered(cache: Path) -> RenderedPairs:
    return RenderedPairs("train", families=[FAMILY], root=cache / "rendered", plan=TINY, workers=1)


@pytest.fixture(scope="session")
def matched(rendered: RenderedPairs, tmp_path_factory: pytest.TempPathFactory) -> MatchedPairs:
    return MatchedPairs(rendered, **SIFT, root=tmp_path_factory.mktemp("matched"), workers=1)


def exact(seed: int = 0, n: int = 200, share: float = 0.5, pairs: int = 1, *, ignored: float = 0.05) -> LabelledMatches:
    """Matches of which `share` are true to machine precision (float64), in images of different cameras."""
    rng = np.random.default_rng(seed)
    rows = [_exact_pair(rng, n, share, ignored) for _ in range(pairs)]
    stacked = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
    label, F = stacked.pop("label"), stacked.pop("F")
    key = torch.tensor([pair_key(f"{seed}/{i}") for i in range(pairs)])
    mask = torch.ones(pairs, n, dtype=torch.bool)
    return LabelledMatches(Correspondences(mask=mask, key=key, **stacked), label, F)


def labelled_pair(number: int, matches: int = 60, outliers: float = 0.4) -> LabelledMatches:
    """A pair to train on, a function of its number: every match is labelled."""
    return exact(number, matches, 1 - outliers, ignored=0.0)


def _exact_pair(rng: np.random.Generator, n: int, share: float, ignored: float) -> dict[str, np.ndarray]:
    sizes = [(480, 640), (300, 500)]
    K0, K1 = (calibration(rng.uniform(300, 900), s, tuple(rng.uniform(0.4, 0.6, 2) * s[::-1])) for s in sizes)
    K0[1, 1] *= 1.1  # pixels that are not square
    R, t = Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix(), rng.normal(size=3)
    x0 = rng.uniform(0, [639, 479], (n, 2))
    depth = rng.uniform(5, 20, (n, 1))
    X = np.column_stack([x0, np.ones(n)]) @ np.linalg.inv(K0).T * depth
    projected = (X @ R.T + t) @ K1.T
    x1 = projected[:, :2] / projected[:, 2:]
    label = (rng.random(n) < share).astype(np.int8)
    label[rng.random(n) < ignored] = -1
    x1 = np.where(label[:, None] == 0, rng.uniform(0, [499, 299], (n, 2)), x1)
    F = np.linalg.inv(K1).T @ skew(t) @ R @ np.linalg.inv(K0)
    frames = [np.concatenate([rng.normal(0, 3, (n, 2, 2)), x[..., None]], -1) for x in (x0, x1)]
    return {
        "x0": x0, "x1": x1, "ratio": rng.uniform(0.3, 1, n), "mutual": rng.random(n) < 0.5,
        "lafs0": frames[0], "lafs1": frames[1], "size0": np.array(sizes[0]), "size1": np.array(sizes[1]),
        "K0": K0, "K1": K1, "label": label, "F": F / np.linalg.norm(F),
    }  # fmt: skip
